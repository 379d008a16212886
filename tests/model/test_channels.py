"""Several pairs of images of the same two visits."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import bayesreg as br
from bayesreg.pose import Pose
from bayesreg.workflow.prediction import mean_values, predict
from tests.phantoms import ball_mesh, smooth_image

MESH = ball_mesh(spacing=30.0)
T1, FLAIR = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
OTHER_T1, OTHER_FLAIR = (smooth_image(MESH.points, seed=seed) for seed in (3, 4))
KNOWN, INFERRED = 2.0, br.ScalePrior(median=2.0)


def pairs(temperature, of_flair):
    of_t1, of_flair = ({"similarity": {"kind": "ssd", "temperature": of_pair}} for of_pair in (temperature, of_flair))
    return [br.ImagePair(T1, OTHER_T1, **of_t1), br.ImagePair(FLAIR, OTHER_FLAIR, name="flair", **of_flair)]


@pytest.mark.parametrize("temperature", [KNOWN, INFERRED])
def test_the_logs_of_both_add_up(temperature):
    both_pairs = pairs(temperature, temperature)
    both, *alone = (br.build_posterior(MESH, some) for some in (both_pairs, both_pairs[:1], both_pairs[1:]))
    u = np.random.default_rng(0).normal(size=(len(MESH.boundary), 3))
    values = {**both.reference(), "u_boundary": u}
    energies = both.energies(values)
    for name, single in zip(("images", "flair"), alone, strict=True):
        its_own = {key: values[key] for key in single.reference()}
        assert float(energies[name]) == pytest.approx(float(single.energies(its_own)[name]), rel=1e-12)


def test_each_has_its_own_temperature_where_it_is_inferred():
    post = br.build_posterior(MESH, pairs(INFERRED, INFERRED))
    values = post.reference()
    assert {"t_similarity", "flair_t_similarity"} <= set(post.estimands(values))
    before, after = post.energies(values), post.energies({**values, "flair_t_similarity": jnp.asarray(3.0)})
    assert float(before["images"]) == float(after["images"])
    alone = br.build_posterior(MESH, pairs(INFERRED, INFERRED)[1:])
    expected = alone.energies({**alone.reference(), "flair_t_similarity": jnp.asarray(3.0)})
    assert float(after["flair"]) == pytest.approx(float(expected["flair"]), rel=1e-12)
    assert float(after["flair"]) != pytest.approx(float(before["flair"]), rel=1e-3)


def test_known_ones_may_differ():
    same, different = (br.build_posterior(MESH, pairs(KNOWN, of_flair)) for of_flair in (KNOWN, 3.0))
    assert [float(different.reference()[name]) for name in ("t_similarity", "flair_t_similarity")] == [2.0, 3.0]
    before, after = (post.energies(post.reference()) for post in (same, different))
    assert float(before["images"]) == float(after["images"])
    assert float(after["flair"]) == pytest.approx(2 / 3 * float(before["flair"]), rel=1e-12)


def test_both_are_checked_for_fit():
    """Each as it is alone."""
    both_pairs, chains, draws = pairs(KNOWN, KNOWN), 2, 3
    both, *alone = (br.build_posterior(MESH, some) for some in (both_pairs, both_pairs[:1], both_pairs[1:]))
    u = np.random.default_rng(0).normal(size=(chains, draws, len(MESH.boundary), 3))
    lame = {name: np.broadcast_to(both.reference()[name], (chains, draws, 3)) for name in ("lam", "mu")}
    dims = {"u_boundary": ("node", "axis"), "lam": ("tissue",), "mu": ("tissue",)}
    posterior = xr.Dataset({n: (("chain", "draw", *dims[n]), x) for n, x in {"u_boundary": u, **lame}.items()})

    def predicted(post):
        still, places = np.zeros_like(MESH.points), {"here": tuple(MESH.points.mean(axis=0))}
        mean = mean_values(post, posterior, still)
        return predict(post, posterior, mean, still, still, places, 0, Pose.identity()).observations

    predictions = predicted(both)
    for name, post in zip(("images", "flair"), alone, strict=True):
        expected = predicted(post)
        assert {f"{name}/observed", f"{name}/replicated", f"{name}/residual"} <= set(expected)
        assert predictions[f"{name}/observed"].shape[:2] == (chains, draws)
        for key, value in expected.items():
            np.testing.assert_allclose(predictions[key], value, rtol=1e-6, atol=1e-6)
    assert abs(predictions["images/observed"] - predictions["flair/observed"]).max() > 0.01


def test_a_name_that_another_pair_has_is_refused():
    with pytest.raises(br.InputError, match="'images' of an observation is taken"):
        br.build_posterior(MESH, 2 * pairs(KNOWN, KNOWN)[:1])
