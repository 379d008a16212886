"""The displacement that a mesh cannot resolve, against scikit-fem's quadratic elements and its own draws."""

from __future__ import annotations

import numpy as np
import pytest
import skfem
from skfem.helpers import dot
from skfem.models.elasticity import linear_elasticity

from bayesreg.fem.elasticity import stiffness
from bayesreg.fem.elements import boundary_areas
from bayesreg.fem.location import locate
from bayesreg.model.coordinates import reference_values
from bayesreg.model.problem import body_of
from bayesreg.model.submesh import unresolved_displacement, unresolved_in
from tests.options import model_of
from tests.phantoms import ball_mesh

MESH = ball_mesh(spacing=22.0)
RNG = np.random.default_rng(0)
PRIORS = {name: {"median": 2.0, "log_sd": 0.5} for name in ("lam", "mu")}
LAM, MU = RNG.uniform(1, 20, len(MESH.cells)), RNG.uniform(0.5, 3, len(MESH.cells))
BODY, SURFACE, RATIO = 0.3, 0.7, RNG.uniform(0.2, 3, len(MESH.points))


@pytest.fixture(scope="module")
def quadratic():
    """scikit-fem's stiffness, mass and boundary mass of quadratic elements; the unknowns of each edge's nodes."""
    grid = skfem.MeshTet(MESH.points.T.copy(), MESH.cells.T.copy(), sort_t=False)
    element = skfem.ElementVector(skfem.ElementTetP2())
    basis, boundary = (kind(grid, element, intorder=4) for kind in (skfem.CellBasis, skfem.FacetBasis))
    mass = skfem.BilinearForm(lambda u, v, w: dot(u, v))
    lam, mu = (np.broadcast_to(x[:, None], (len(x), basis.X.shape[1])) for x in (LAM, MU))
    stiffness = skfem.asm(linear_elasticity(lam, mu), basis).tocsr()
    unknowns = {tuple(sorted(nodes)): of_edge for nodes, of_edge in zip(grid.edges.T, basis.edge_dofs.T, strict=True)}
    return stiffness, mass.assemble(basis).tocsr(), mass.assemble(boundary).tocsr(), unknowns


def test_it_is_the_response_of_quadratic_elements_to_the_loads(quadratic):
    stiffness, mass, of_boundary, unknowns = quadratic
    unresolved = unresolved_displacement(MESH, LAM, MU, BODY, SURFACE, RATIO)
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    at_boundary = 0
    for cell in range(0, len(MESH.cells), 7):
        for number, pair in zip(unresolved.edges[cell], pairs, strict=True):
            ends = MESH.cells[cell, list(pair)]
            rows = unknowns[tuple(sorted(ends.tolist()))]
            K = stiffness[rows][:, rows].toarray()
            loads = (BODY**2 * mass + SURFACE**2 * of_boundary)[rows][:, rows].toarray()
            by_loads = RATIO[ends].mean() * np.linalg.solve(K, np.linalg.solve(K, loads).T)
            greatest = 0.25 * np.linalg.norm(np.diff(MESH.points[ends], axis=0)) / 4
            expected = np.linalg.inv(np.linalg.inv(by_loads) + np.eye(3) / greatest**2)
            np.testing.assert_allclose(unresolved.covariance[number], expected, rtol=1e-8, atol=1e-12)
            at_boundary += of_boundary[rows[0], rows[0]] > 0
    assert at_boundary > 20


def test_draws_have_the_covariance_and_no_jumps():
    unresolved = unresolved_displacement(MESH, LAM, MU, BODY, SURFACE, RATIO)
    cells, barycentric = RNG.integers(len(MESH.cells), size=30), RNG.dirichlet(np.ones(4), 30)
    u = np.array([unresolved.displacement(unresolved.draw((3, k)), cells, barycentric) for k in range(4000)])
    covariance = unresolved.covariance_at(cells, barycentric)
    np.testing.assert_allclose(np.einsum("ski,skj->kij", u, u) / len(u), covariance, atol=0.15 * covariance.max())
    np.testing.assert_allclose((u**2).mean(axis=0), unresolved.variance_at(cells, barycentric), rtol=0.15)
    assert (unresolved.covariance_at(cells[:4], np.eye(4)) == 0).all()
    # A point on the face between two tetrahedra, from either side.
    amplitudes = unresolved.draw((0,))
    compared = 0
    for first in range(0, len(MESH.cells), 11):
        for second in range(len(MESH.cells)):
            shared = np.intersect1d(MESH.cells[first], MESH.cells[second])
            if first == second or len(shared) < 3:
                continue
            share = np.array([0.2, 0.3, 0.5])
            sides = [
                unresolved.displacement(
                    amplitudes,
                    np.array([cell]),
                    np.array([[dict(zip(shared, share, strict=True)).get(node, 0.0) for node in MESH.cells[cell]]]),
                )
                for cell in (first, second)
            ]
            np.testing.assert_allclose(*sides, atol=1e-12)
            compared += 1
    assert compared > 20


def test_a_rotation_turns_the_covariance_and_no_loads_leave_nothing():
    unresolved = unresolved_displacement(MESH, LAM, MU, BODY, SURFACE, RATIO)
    turn = np.linalg.qr(RNG.standard_normal((3, 3)))[0]
    np.testing.assert_allclose(
        unresolved.turned(turn).covariance, turn @ unresolved.covariance @ turn.T, rtol=1e-9, atol=1e-12
    )
    assert (unresolved_displacement(MESH, LAM, MU, 0.0, 0.0, RATIO).covariance == 0).all()


def test_loads_on_the_surface_alone_move_nothing_inside():
    surface = unresolved_displacement(MESH, LAM, MU, 0.0, SURFACE, RATIO)
    middle = MESH.points.mean(axis=0, keepdims=True)
    cell, barycentric = locate(MESH.points, MESH.cells, middle)
    assert (surface.covariance_at(cell, barycentric) == 0).all()
    assert surface.covariance.any()


def test_strains_of_a_soft_tissue_are_limited():
    soft = unresolved_displacement(MESH, 1e-4 * LAM, 1e-4 * MU, BODY, SURFACE, RATIO)
    nodes = np.unique(np.sort(MESH.cells[:, [(a, b) for a in range(4) for b in range(a)]].reshape(-1, 2)), axis=0)
    length = np.linalg.norm(np.diff(MESH.points[nodes], axis=1)[:, 0], axis=1)
    sd = np.sqrt(np.linalg.eigvalsh(soft.covariance))
    np.testing.assert_allclose(4 * sd / length[:, None], 0.25, rtol=0.02)


def test_draws_of_the_prior_tell_its_own_loads():
    """Loads of the prior in every node but one, which has none: the ratio is one, and zero there."""
    body, blocks = body_of(MESH, model_of(body_load=BODY, surface_load=SURFACE, priors=PRIORS))
    values = reference_values(blocks)
    lam, mu = (np.asarray(x) for x in body.lame_by_cell(values))
    K = stiffness(MESH, lam, mu).toarray()
    variances = BODY**2 * MESH.nodal_volumes + SURFACE**2 * boundary_areas(MESH)
    variances[MESH.interior[0]] = 0
    loads = np.sqrt(variances)[:, None] * RNG.standard_normal((150, len(MESH.points), 3))
    draws = np.linalg.lstsq(K, loads.reshape(150, -1).T)[0].T.reshape(loads.shape)
    told = unresolved_in(body, values, draws)
    ratio = np.ones(len(MESH.points))
    alone = unresolved_displacement(MESH, lam, mu, BODY, SURFACE, ratio)
    np.testing.assert_allclose(unresolved_in(body, values, draws[:0]).covariance, alone.covariance)
    ratio[MESH.interior[0]] = 0
    expected = unresolved_displacement(MESH, lam, mu, BODY, SURFACE, ratio)
    traces = [np.trace(x.covariance, axis1=1, axis2=2) for x in (told, expected)]
    np.testing.assert_allclose(*traces, rtol=0.35)
    assert np.mean(traces[0] / traces[1]) == pytest.approx(1, abs=0.03)
