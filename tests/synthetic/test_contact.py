"""The elastic body in contact: optimality conditions, and other solvers on a small mesh."""

import numpy as np
import pytest
from scipy.optimize import minimize, nnls

from bayesreg.fem.elasticity import stiffness
from bayesreg.synthetic.contact import ContactProblem, complementarity
from tests.phantoms import LAM, MU, PAPER_LAM, PAPER_MU, ball_mesh, box_mesh

CENTRE = np.array([10.0, 10.0, 10.0])


def _cavity(radius, centre):
    """A ball-shaped cavity: distance to its wall, and the gradient of that."""

    def gap(points):
        outwards = points - centre
        distance = np.linalg.norm(outwards, axis=1)
        return radius - distance, -outwards / distance[:, None]

    return gap


def _pushed_box(lam, mu, radius=18.5):
    """A cube of 20 mm, its side x = 0 pushed by 3 mm towards the far wall of a cavity that its corners touch."""
    mesh = box_mesh()
    held = mesh.boundary[mesh.points[mesh.boundary, 0] < 1e-9]
    held_u = np.tile([3.0, 0.5, 0.0], (len(held), 1))
    problem = ContactProblem(mesh, stiffness(mesh, lam, mu), held, held_u, _cavity(radius, CENTRE))
    return mesh, held, held_u, problem


@pytest.mark.parametrize(("lam", "mu"), [(LAM, MU), (PAPER_LAM, PAPER_MU)])
def test_optimality_conditions(lam, mu):
    mesh, held, held_u, problem = _pushed_box(lam, mu)
    floor = np.full(len(mesh.points), 0.2)
    u, force, violation, stationarity, _, converged = problem.solve(floor)
    assert converged
    assert max(violation, stationarity) < 1e-6
    np.testing.assert_array_equal(u[held], held_u)
    free = np.setdiff1d(mesh.boundary, held)
    gap, normal = _cavity(18.5, CENTRE)(mesh.points + u)
    assert gap[free].min() > 0.2 - 1e-6
    assert (force >= 0).all()
    assert not force[held].any()
    assert not force[mesh.interior].any()
    assert 3 <= np.count_nonzero(force) < len(free)
    np.testing.assert_allclose(gap[force > 0], 0.2, atol=1e-6)
    stiff = stiffness(mesh, lam, mu)
    balance = (stiff @ u.ravel()).reshape(-1, 3) - force[:, None] * normal
    scale = stiff.diagonal().reshape(-1, 3)
    assert np.abs(np.delete(balance / scale, held, axis=0)).max() < 1e-6


def test_the_energy_is_that_of_another_solver():
    mesh, held, held_u, problem = _pushed_box(LAM, MU)
    solution = problem.solve(np.full(len(mesh.points), 0.2))
    stiff = stiffness(mesh, LAM, MU).toarray()
    free = np.setdiff1d(np.arange(len(mesh.points)), held)
    bounded = np.setdiff1d(mesh.boundary, held)
    gap = _cavity(18.5, CENTRE)

    def whole(x):
        u = np.zeros_like(mesh.points)
        u[held], u[free] = held_u, x.reshape(-1, 3)
        return u

    def gradient(x):
        return (stiff @ whole(x).ravel()).reshape(-1, 3)[free].ravel()

    def constraint_jacobian(x):
        _, normal = gap((mesh.points + whole(x))[bounded])
        jacobian = np.zeros((len(bounded), len(free), 3))
        jacobian[np.arange(len(bounded)), np.searchsorted(free, bounded)] = normal
        return jacobian.reshape(len(bounded), -1)

    minimum = minimize(
        lambda x: 0.5 * whole(x).ravel() @ stiff @ whole(x).ravel(),
        np.zeros(3 * len(free)),
        jac=gradient,
        method="SLSQP",
        constraints={
            "type": "ineq",
            "fun": lambda x: gap((mesh.points + whole(x))[bounded])[0] - 0.2,
            "jac": constraint_jacobian,
        },
        options={"ftol": 1e-10, "maxiter": 500},
    )
    assert minimum.success
    energy = 0.5 * solution.u.ravel() @ stiff @ solution.u.ravel()
    assert energy == pytest.approx(minimum.fun, rel=1e-8)
    np.testing.assert_allclose(solution.u, whole(minimum.x), atol=1e-4)


def test_without_an_obstacle_the_body_just_translates():
    mesh, _, held_u, problem = _pushed_box(PAPER_LAM, PAPER_MU, radius=100.0)
    result = problem.solve(np.zeros(len(mesh.points)))
    assert not result.force.any()
    np.testing.assert_allclose(result.u, np.tile(held_u[0], (len(mesh.points), 1)), atol=1e-8)


def test_a_solution_serves_as_start_for_other_floors():
    mesh, _, _, problem = _pushed_box(LAM, MU)
    low, high = np.full(len(mesh.points), 0.2), np.full(len(mesh.points), 0.4)
    warm = problem.solve(high, start=problem.solve(low))
    cold = problem.solve(high)
    assert warm.converged
    assert warm.iterations < cold.iterations
    np.testing.assert_allclose(warm.u, cold.u, atol=1e-6)


def test_many_contacts_on_a_ball_of_high_contrast():
    mesh = ball_mesh()
    centre = np.array([5.0, -3.0, 8.0])
    held = mesh.boundary[np.argsort(-mesh.points[mesh.boundary, 2])[:6]]
    towards = centre - mesh.points[held]
    held_u = 8 * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    problem = ContactProblem(mesh, stiffness(mesh, PAPER_LAM, PAPER_MU), held, held_u, _cavity(41.5, centre))
    result = problem.solve(np.full(len(mesh.points), 0.1))
    assert result.converged
    assert np.count_nonzero(result.force) > 10


def test_a_budget_too_small_is_admitted():
    mesh, _, _, problem = _pushed_box(LAM, MU)
    result = problem.solve(np.full(len(mesh.points), 0.2), load_steps=1, max_iterations=1)
    assert not result.converged


@pytest.mark.parametrize("size", [1, 5, 60])
@pytest.mark.parametrize("seed", range(4))
def test_complementarity_equals_nonnegative_least_squares(size, seed):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(size, size)) * 10 ** rng.uniform(-2, 2, size)
    matrix, demand = factor.T @ factor, factor.T @ rng.normal(size=size)
    x = complementarity(matrix, demand, rng.random(size) < 0.5)
    expected, _ = nnls(np.linalg.cholesky(matrix).T, np.linalg.solve(np.linalg.cholesky(matrix), demand))
    np.testing.assert_allclose(x, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())
