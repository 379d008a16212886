"""The barrier against inverted tetrahedra: closed forms, and a search that landmarks pull through a face."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.fem.elements import elements_of
from bayesreg.inference.gaussian import mode_search
from bayesreg.inference.gaussian.evidence import maximise_evidence
from bayesreg.inference.gaussian.hierarchy import mark_hyperparameters
from bayesreg.inference.gaussian.mode_search import find_mode
from bayesreg.inference.layout import flat_position, unravel
from bayesreg.mesh import signed_volumes
from bayesreg.model.curvature import _assemble
from bayesreg.model.elastic.barrier import QUADRATIC_BELOW, WIDTH, Barrier, cost, volume_shares
from bayesreg.model.observations.landmarks import Landmarks
from tests.options import model_of
from tests.phantoms import box_mesh


def squeezed(share):
    """log of the barrier of 0.1 at one tetrahedron that is left with this share of its volume."""
    return -cost(jnp.asarray(share / 0.1))


def build(mesh, fixed, moving, least_volume):
    marks = Landmarks(fixed, moving, sd=0.1)
    model = model_of(sampled="all", least_volume=least_volume, fixed={"lam": 1.0, "mu": 1.0})
    return br.build_posterior(mesh, [marks], model)


def test_shares_are_those_of_the_volumes():
    mesh = box_mesh()
    u = np.random.default_rng(0).normal(scale=5.0, size=mesh.points.shape)
    shares = volume_shares(elements_of(mesh), jnp.asarray(u))
    moved = signed_volumes(mesh.points + u, mesh.cells)
    assert (moved < 0).any()
    np.testing.assert_allclose(shares, moved / mesh.volumes, rtol=1e-9, atol=1e-12)


def test_it_is_silent_above_the_least_volume_and_steep_below():
    assert squeezed(0.1001) == 0
    assert squeezed(1.5) == 0
    assert squeezed(0.05) == pytest.approx(-0.5 * (np.log(2) / WIDTH) ** 2)
    assert squeezed(0.0) < -237
    assert squeezed(-1.0) < squeezed(0.0)


def test_it_is_smooth_where_its_quadratic_part_begins():
    above, below = (0.1 * QUADRATIC_BELOW + step for step in (1e-9, -1e-9))
    for function in (squeezed, jax.grad(squeezed), jax.grad(jax.grad(squeezed))):
        assert float(function(above)) == pytest.approx(float(function(below)), rel=1e-5)


@pytest.mark.parametrize("shift", [0.0, 0.9, 1.3])
def test_its_curvature_is_that_of_the_linearised_volumes(shift):
    """None of the volumes below the least, some, and some inverted: the Hessian where J is linear in u."""
    mesh = box_mesh()
    barrier = build(mesh, mesh.points, mesh.points, 0.1).data.terms["barrier"]
    u = np.random.default_rng(1).normal(scale=0.1, size=mesh.points.shape)
    apex, *others = mesh.cells[len(mesh.cells) // 2]
    u[apex] += shift * (mesh.points[others].mean(axis=0) - mesh.points[apex])
    shares, push = jax.linearize(lambda u: volume_shares(barrier.elements, u), jnp.asarray(u))
    assert (np.asarray(shares) < 0.1).any() == bool(shift)
    curved = jax.hessian(lambda step: cost((shares + push(step)) / 0.1).sum())(jnp.zeros_like(u))
    curvature = _assemble(len(u), barrier.gauss_newton(jnp.asarray(u), {})).toarray()
    np.testing.assert_allclose(curvature, curved.reshape(curvature.shape), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("least", [0.0, pytest.param(0.1, marks=pytest.mark.long)])
def test_the_mode_has_no_inverted_tetrahedron(least):
    """Landmarks that pull a node through the opposite faces; without the barrier it goes there."""
    mesh = box_mesh()
    middle = int(np.argmin(np.linalg.norm(mesh.points - mesh.points.mean(axis=0), axis=1)))
    rest = mesh.boundary[mesh.boundary != middle]
    fixed = mesh.points[np.append(rest, middle)]
    moving = fixed.copy()
    moving[-1] += 1.5 * (mesh.points[rest[0]] - mesh.points[middle])
    posterior = build(mesh, fixed, moving, least)
    start = np.asarray(flat_position(posterior.target, posterior.data, posterior.estimands(posterior.reference())))
    mode = unravel(posterior.target)(jnp.asarray(find_mode(posterior.target, start)))
    u = np.asarray(posterior.constrain(mode)["u_boundary"])
    assert (signed_volumes(mesh.points + u, mesh.cells).min() > 0) == bool(least)


def test_the_preset_has_it_and_it_is_refused_outside_its_range():
    assert br.ModelConfig(preset="registration").least_volume > 0
    assert isinstance(build(box_mesh(), box_mesh().points, box_mesh().points, 0.1).data.terms["barrier"], Barrier)
    with pytest.raises(ValueError, match="less than 1"):
        br.ModelConfig(least_volume=1.0)


@pytest.mark.parametrize("wild", [1e3, np.nan])
def test_displacements_that_the_evidence_takes_too_far_rest(wild, monkeypatch):
    """The search ends where it ends without such a step."""
    mesh = box_mesh()
    marks = mesh.points[::2]
    landmarks = Landmarks(marks, marks + np.random.default_rng(0).normal(size=marks.shape), sd=0.5)
    model = model_of(
        sampled="all", least_volume=0.1, normalised=True, t_elastic={"median": 10.0}, fixed={"lam": 1.0, "mu": 1.0}
    )
    posterior = br.build_posterior(mesh, [landmarks], model)
    start = np.asarray(flat_position(posterior.target, posterior.data, posterior.estimands(posterior.reference())))
    expected, searches = find_mode(posterior.target, start), []

    def go_too_far(target, flat, *rest):
        maximum = maximise_evidence(target, flat, *rest)
        searches.append(maximum)
        away = wild * np.random.default_rng(1).normal(size=flat.shape)
        far = np.where(mark_hyperparameters(target), maximum.flat, maximum.flat + away)
        return maximum._replace(flat=far) if len(searches) == 1 else maximum

    monkeypatch.setattr(mode_search, "maximise_evidence", go_too_far)
    np.testing.assert_allclose(find_mode(posterior.target, start), expected, atol=0.02)
    assert len(searches) > 1
