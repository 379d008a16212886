"""What linear elasticity must do whatever the mesh: patch test, rigid motions, convergence."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.linalg import splu

import bayesreg as br
from bayesreg.fem.elasticity import stiffness
from tests.oracles.paper import FOUR_POINTS, mesh_rule, rigid_modes, shape_gradients
from tests.phantoms import LAM, MU, ball_mesh, box_mesh, refined


@pytest.fixture(scope="module")
def mesh():
    return ball_mesh(spacing=18.0)


def test_linear_displacements_pass_the_patch_test(mesh):
    rng = np.random.default_rng(0)
    gradient, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
    u = mesh.points @ gradient.T + shift
    solution = br.solve_interior(mesh, np.array([10.0]), np.array([1.0]), u[mesh.boundary])
    np.testing.assert_allclose(solution.u, u, atol=1e-7 * abs(u).max())
    strain = (gradient + gradient.T) / 2
    density = 1.0 * (strain**2).sum() + 10.0 / 2 * np.trace(gradient) ** 2
    energy = float(br.strain_energy(mesh, np.array([10.0]), np.array([1.0]), u))
    assert energy == pytest.approx(density * mesh.volumes.sum(), rel=1e-12)


def test_rigid_motions_cost_nothing(mesh):
    scale = float(br.strain_energy(mesh, LAM, MU, np.random.default_rng(1).normal(size=mesh.points.shape)))
    for mode in rigid_modes(mesh.points).T:
        u = mode.reshape(-1, 3) * np.sqrt(len(mesh.points))
        assert abs(float(br.strain_energy(mesh, LAM, MU, u))) < 1e-26 * scale
        force = stiffness(mesh, LAM, MU) @ u.ravel()
        assert abs(force).max() < 1e-13 * abs(stiffness(mesh, LAM, MU)).max() * abs(u).max()


def test_rigid_boundary_motion_moves_the_interior_rigidly(mesh):
    for mode in rigid_modes(mesh.points).T:
        u = mode.reshape(-1, 3) * 10
        solution = br.solve_interior(mesh, LAM, MU, u[mesh.boundary])
        np.testing.assert_allclose(solution.u, u, atol=1e-7 * abs(u).max())


@pytest.mark.parametrize("function", [br.strain_energy, br.solve_interior])
def test_wrong_shapes_are_refused(mesh, function):
    rows = len(mesh.points) if function is br.strain_energy else len(mesh.boundary)
    with pytest.raises(ValueError, match=r"shape \(3,\) by tissue .* got \(2,\)"):
        function(mesh, LAM[:2], MU[:2], np.zeros((rows, 3)))
    with pytest.raises(ValueError, match=rf"must have shape \({rows}, 3\), got \({rows - 1}, 3\)"):
        function(mesh, LAM, MU, np.zeros((rows - 1, 3)))


class Manufactured:
    """u(x) smooth on [0, 1]³, and the body force that holds it: b = −μ Δu − (λ + μ) ∇ div u."""

    lam, mu = 1.5, 1.0

    @staticmethod
    def u(x):
        a, b, c = np.moveaxis(x, -1, 0)
        return np.stack(
            [np.sin(2 * a + b) * np.cos(c), np.cos(a) * np.sin(b + 2 * c), np.sin(a * 2) * np.cos(b - c)], -1
        )

    @staticmethod
    def gradient(x):
        """[..., i, j] = ∂_j u_i."""
        a, b, c = np.moveaxis(x, -1, 0)
        sin, cos = np.sin, np.cos
        rows = [
            [2 * cos(2 * a + b) * cos(c), cos(2 * a + b) * cos(c), -sin(2 * a + b) * sin(c)],
            [-sin(a) * sin(b + 2 * c), cos(a) * cos(b + 2 * c), 2 * cos(a) * cos(b + 2 * c)],
            [2 * cos(2 * a) * cos(b - c), -sin(2 * a) * sin(b - c), sin(2 * a) * sin(b - c)],
        ]
        return np.stack([np.stack(row, -1) for row in rows], -2)

    def force(self, x, h=1e-4):
        """Divergence of the exact stress by central differences (error ~1e-8, far below the discretisation)."""

        def stress(y):
            g = self.gradient(y)
            trace = np.trace(g, axis1=-2, axis2=-1)[..., None, None]
            return self.mu * (g + np.swapaxes(g, -1, -2)) + self.lam * trace * np.eye(3)

        return -sum((stress(x + h * e)[..., j] - stress(x - h * e)[..., j]) / (2 * h) for j, e in enumerate(np.eye(3)))


def test_manufactured_gradient_is_the_derivative():
    exact, x, h = Manufactured(), np.random.default_rng(3).uniform(size=(7, 3)), 1e-5
    columns = [(exact.u(x + h * e) - exact.u(x - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(exact.gradient(x), np.stack(columns, -1), atol=1e-9)


def errors(mesh, exact):
    """L2 norm and H1 seminorm of the error of the P1 solution with body force and Dirichlet boundary."""
    owner, barycentric, weight = mesh_rule(mesh.points, mesh.cells, "gauss32")
    corners = mesh.cells[owner]
    x = np.einsum("qa,qai->qi", barycentric, mesh.points[corners])
    load = np.zeros(mesh.points.shape)
    contribution = weight[:, None, None] * barycentric[:, :, None] * exact.force(x)[:, None, :]
    np.add.at(load, corners, contribution)
    K = stiffness(mesh, np.array([exact.lam]), np.array([exact.mu])).tocsc()
    u = exact.u(mesh.points)
    free = (3 * mesh.interior[:, None] + np.arange(3)).ravel()
    u[mesh.interior] = 0
    right = load.ravel() - K @ u.ravel()
    u[mesh.interior] = splu(K[free][:, free]).solve(right[free]).reshape(-1, 3)
    missed = np.einsum("qa,qai->qi", barycentric, u[corners]) - exact.u(x)
    slopes = np.array([shape_gradients(mesh.points[cell]) for cell in mesh.cells])
    gradient = np.einsum("mai,maj->mij", u[mesh.cells], slopes)[owner] - exact.gradient(x)
    return np.sqrt(weight @ (missed**2).sum(-1)), np.sqrt(weight @ (gradient**2).sum((-1, -2)))


def test_manufactured_solution_converges_at_the_rates_of_linear_elements():
    assert FOUR_POINTS.sum(axis=1) == pytest.approx(1)
    coarse = refined(box_mesh(2, size=1.0))
    fine = refined(coarse)
    (l2_coarse, h1_coarse), (l2_fine, h1_fine) = (errors(m, Manufactured()) for m in (coarse, fine))
    assert np.log2(l2_coarse / l2_fine) == pytest.approx(2.0, abs=0.15)
    assert np.log2(h1_coarse / h1_fine) == pytest.approx(1.0, abs=0.15)
