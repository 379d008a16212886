"""The trace of a covariance times the quadratic part of the curvature, against the product of the two matrices."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.gaussian.density import estimands_at
from bayesreg.inference.gaussian.evidence import dense
from bayesreg.inference.gaussian.hierarchy import mark_hyperparameters
from bayesreg.inference.layout import flat_position
from bayesreg.model.blocks import scale_block
from bayesreg.model.field import FieldConfig
from tests.options import model_of
from tests.phantoms import ball_mesh, smooth_image

MESH = ball_mesh(spacing=30.0)
WIDE = br.ScalePrior(median=0.5, log_sd=1.0)
PRIORS = {"priors": {name: {"high": 60.0} for name in ("lam", "mu")}}
# 25 tissues, of which the first has an unknown λ and μ.
NAMES = tuple(f"part{k}" for k in range(25))
MANY_TISSUES = br.TetMesh.from_arrays(MESH.points, MESH.cells, np.arange(len(MESH.cells)) % 25, NAMES)
FIXED = {"lam": dict.fromkeys(NAMES[1:], 10.0), "mu": dict.fromkeys(NAMES[1:], 1.0)}
BOUNDARY = {"normalised": True, "t_elastic": WIDE, "rigid_sd": 2.0, **PRIORS}


class Volume:
    """A term from outside, with a scale of its own, of the mean displacement."""

    name = "volume"
    blocks: ClassVar = {"volume_sd": scale_block(WIDE)}

    def log(self, state):
        sd = state.values["volume_sd"]
        return -((state.u.mean(axis=0) - 1) ** 2).sum() / (2 * sd**2) - 3 * jnp.log(sd)


class Stiffness:
    """A term from outside whose curvature depends on μ."""

    name = "stiffness"

    def log(self, state):
        return -0.05 * state.mu.mean() ** 2 * (state.u[:9] ** 2).sum()


def landmarks():
    marks = MESH.points[::3] * 0.9
    return br.Landmarks(marks, marks + 1.0, sd=WIDE)


def images():
    return br.ImagePair(*(smooth_image(MESH.points, seed=seed) for seed in (1, 2)))


@pytest.mark.parametrize(
    ("mesh", "options", "observations"),
    [
        (MESH, {"body_load": WIDE, "surface_load": WIDE, **PRIORS}, [images, landmarks]),
        (MANY_TISSUES, {"body_load": WIDE, "surface_load": 0.5, "fixed": FIXED, **PRIORS}, [landmarks]),
        (MESH, BOUNDARY, [images, landmarks, Volume, Stiffness]),
        (MESH, {**BOUNDARY, "sampled": "all"}, [landmarks]),
        (
            MESH,
            {"elasticity": "field", "field": FieldConfig(modes=5, correlation=30.0), **BOUNDARY},
            [images, landmarks],
        ),
        (
            MESH,
            {
                "elasticity": "field",
                "field": FieldConfig(modes=5, correlation=30.0),
                "body_load": WIDE,
                "surface_load": WIDE,
                **PRIORS,
            },
            [landmarks],
        ),
        (MESH, {"elasticity": "element", "t_elastic": WIDE, "normalised": True, **PRIORS}, [landmarks]),
    ],
    ids=["loads", "many tissues", "boundary", "all nodes", "field", "field with loads", "elements"],
)
def test_the_trace_is_that_of_the_product(mesh, options, observations):
    posterior = br.build_posterior(mesh, [make() for make in observations], model_of(**options))
    target, search = posterior.target, posterior.target.mode_search
    data = search.quadratic_part(target.data)
    rng = np.random.default_rng(0)
    near = np.asarray(flat_position(target, target.data, posterior.estimands(posterior.reference())))
    near = near + 0.01 * rng.normal(size=near.shape)
    entries = np.flatnonzero(mark_hyperparameters(target))
    assert len(entries) > 1

    def estimands(flat):
        return estimands_at(target, data, jnp.asarray(flat))

    def curvature(flat):
        return dense(search.quadratic_curvature(data, estimands(flat), estimands(near)))

    at_near = curvature(near)
    root = rng.normal(size=at_near.shape)
    covariance = root @ root.T / len(root)
    trace = search.quadratic_trace(data, estimands(near), covariance)
    for _ in range(3):
        flat = np.array(near)
        flat[entries] += 0.3 * rng.normal(size=len(entries))
        expected = np.vdot(covariance, curvature(flat) - at_near)
        assert trace(estimands(flat)) - trace(estimands(near)) == pytest.approx(expected, rel=1e-8)
