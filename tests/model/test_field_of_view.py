"""A moving image that reaches a part of the organ: what lies beyond its grid says nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.image import Image
from tests.options import model_of
from tests.phantoms import box_mesh

MESH = box_mesh(3, size=30.0)
AFFINE = np.diag([1.5, 1.5, 1.5, 1.0])
VOXELS = np.random.default_rng(0).normal(size=(21, 21, 21))
OTHER = np.random.default_rng(1).normal(size=(21, 21, 21))
FIXED, WHOLE, SLAB = Image(VOXELS, AFFINE), Image(OTHER, AFFINE), Image(OTHER[:, :, :13], AFFINE)
# The last voxel of the slab ends here, mm.
END = 12.5 * 1.5


@pytest.mark.parametrize("quadrature", ["gauss4", "gauss32", "voxels"])
def test_no_point_beyond_the_grid_is_compared(quadrature):
    term = build(SLAB, quadrature).data.terms["images"]
    whole_term = build(WHOLE, quadrature).data.terms["images"]
    expected = np.asarray(whole_term.positions)[np.asarray(whole_term.positions)[:, 2] <= END]
    np.testing.assert_allclose(term.positions, expected)
    assert float(term.quadrature.weights.sum()) < float(whole_term.quadrature.weights.sum())


def test_images_do_not_pull_where_nothing_is_seen():
    posterior = build(SLAB, "gauss32")
    reference = posterior.reference()
    position = posterior.unconstrain(reference)
    pull = jax.grad(lambda x: posterior.logdensity(x))(position)["u_boundary"]
    without = build(None, None)
    prior = jax.grad(lambda x: without.logdensity(x))(without.unconstrain(without.reference()))
    difference = np.linalg.norm(np.asarray(pull) - np.asarray(prior["u_boundary"]), axis=1)
    nodes = np.asarray(posterior.sampled)
    touched = {int(node) for cell in MESH.cells[MESH.points[MESH.cells][:, :, 2].min(axis=1) < END] for node in cell}
    beyond = np.array([int(node) not in touched for node in nodes])
    assert beyond.any()
    np.testing.assert_allclose(difference[beyond], 0, atol=1e-10)
    assert (difference[MESH.points[nodes, 2] < END / 2] > 1e-6).all()


def build(moving, quadrature):
    rule = {} if quadrature is None else {"quadrature": quadrature}
    model = model_of(sampled="all", fixed={"lam": 1.0, "mu": 1.0})
    pair = [] if moving is None else [br.ImagePair(FIXED, moving, **rule)]
    marks = br.Landmarks(MESH.points[:9], MESH.points[:9], sd=1.0)
    return br.build_posterior(MESH, [*pair, marks], model)


def test_the_state_of_a_slab_is_finite():
    posterior = build(SLAB, "voxels")
    log_density = posterior.logdensity(posterior.unconstrain(posterior.reference()))
    assert jnp.isfinite(log_density)
