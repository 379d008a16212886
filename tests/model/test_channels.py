"""Several pairs of images of the same two visits."""

from __future__ import annotations

import numpy as np
import pytest

import bayesreg as br
from tests.phantoms import ball_mesh, smooth_image

MESH = ball_mesh(spacing=30.0)
T1, FLAIR = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
OTHER_T1, OTHER_FLAIR = (smooth_image(MESH.points, seed=seed) for seed in (3, 4))
PAIRS = [br.ImagePair(T1, OTHER_T1, name="t1"), br.ImagePair(FLAIR, OTHER_FLAIR, name="flair")]


def build(observations, t_similarity):
    model = br.ModelConfig(t_similarity=t_similarity)
    return br.build_posterior(mesh=MESH, observations=observations, model=model)


def test_the_logs_of_both_add_up():
    both, *alone = (build(pairs, 2.0) for pairs in (PAIRS, PAIRS[:1], PAIRS[1:]))
    u = np.random.default_rng(0).normal(size=(len(MESH.boundary), 3))
    values = {**both.reference(), "u_boundary": u}
    found = both.energies(values)
    for name, one in zip(("t1", "flair"), alone, strict=True):
        assert float(found[name]) == pytest.approx(float(one.energies(values)[name]), rel=1e-12)


def test_each_has_its_own_temperature_where_it_is_inferred():
    post = build(PAIRS, {"median": 2.0, "log_sd": 1.0})
    values = post.reference()
    assert {"t_similarity", "flair_t_similarity"} <= set(values)
    before = post.energies(values)
    after = post.energies({**values, "flair_t_similarity": 3.0})
    assert float(before["t1"]) == float(after["t1"])
    alone = build(PAIRS[1:], {"median": 2.0, "log_sd": 1.0})
    expected = alone.energies({**alone.reference(), "t_similarity": 3.0})
    assert float(after["flair"]) == pytest.approx(float(expected["flair"]), rel=1e-12)


def test_known_they_share_one():
    assert "flair_t_similarity" not in build(PAIRS, 2.0).reference()
