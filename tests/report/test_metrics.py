import numpy as np
import pytest
import xarray as xr

from bayesreg.io.records import Truth
from bayesreg.mesh import TetMesh
from bayesreg.report import metrics
from tests.phantoms import ball_mesh, box_mesh


def by_quadrature(mesh: TetMesh, field: np.ndarray) -> np.ndarray:
    """∫ |e|² of every cell by the four-point rule, exact for quadratics, one cell at a time."""
    a, b = (5 + 3 * 5**0.5) / 20, (5 - 5**0.5) / 20
    barycentrics = np.full((4, 4), b) + (a - b) * np.eye(4)
    result = []
    for cell, volume in zip(mesh.cells, mesh.volumes, strict=True):
        values = barycentrics @ field[cell]
        result.append(volume / 4 * (values**2).sum())
    return np.array(result)


def test_squared_integral_equals_quadrature():
    mesh = ball_mesh(40.0, 18.0)
    field = np.random.default_rng(0).normal(size=mesh.points.shape)
    np.testing.assert_allclose(metrics.squared_integral(mesh, field), by_quadrature(mesh, field), rtol=1e-12)


def test_mean_squared_error_by_tissue():
    mesh = ball_mesh(40.0, 18.0)
    rng = np.random.default_rng(1)
    u, truth = rng.normal(size=(2, *mesh.points.shape))
    errors = metrics.mean_squared_error(mesh, u, truth)
    integral = by_quadrature(mesh, u - truth)
    assert errors["domain"] == pytest.approx(integral.sum() / mesh.volumes.sum(), rel=1e-12)
    for k, name in enumerate(mesh.names):
        inside = mesh.tissue == k
        assert errors[name] == pytest.approx(integral[inside].sum() / mesh.volumes[inside].sum(), rel=1e-12)


def test_mean_squared_error_of_a_constant_shift_and_of_an_absent_tissue():
    mesh = box_mesh()
    mesh = TetMesh.from_arrays(mesh.points, mesh.cells, np.zeros(len(mesh.cells), int), ("csf", "gm"))
    truth = np.zeros_like(mesh.points)
    errors = metrics.mean_squared_error(mesh, truth + np.array([1.0, 2.0, -2.0]), truth)
    assert errors == pytest.approx({"domain": 9.0, "csf": 9.0})


def test_boundary_error_looks_at_the_given_nodes_only():
    truth = np.zeros((101, 3))
    u = np.zeros((101, 3))
    u[:100, 1] = np.arange(100)
    u[100] = 1e6
    errors = metrics.boundary_error(u, truth, np.arange(100))
    assert errors == pytest.approx({"median": 49.5, "q95": 94.05, "max": 99.0})


def test_divergence_of_a_linear_field_is_the_trace():
    mesh = ball_mesh(40.0, 24.0)
    gradient = np.random.default_rng(2).normal(size=(3, 3))
    u = mesh.points @ gradient.T + (1.0, 2.0, 3.0)
    np.testing.assert_allclose(metrics.divergence(mesh, u), np.trace(gradient), rtol=1e-10)


def test_coverage_of_a_calibrated_posterior_and_of_one_too_narrow():
    rng = np.random.default_rng(3)
    truth = rng.normal(size=3000)
    draws = rng.normal(size=(400, 3000))
    wide, narrow = metrics.coverage(draws, truth), metrics.coverage(0.3 * draws, truth)
    for level in metrics.COVERAGE_LEVELS:
        assert wide[f"{level:g}"] == pytest.approx(level, abs=0.03)
        assert narrow[f"{level:g}"] < level - 0.2


def test_entries_that_never_move_do_not_count():
    draws = np.random.default_rng(4).normal(size=(200, 2))
    draws[:, 1] = 7.0
    assert metrics.coverage(draws, np.array([0.0, 0.0]))["0.95"] == 1.0


def test_metrics_of_a_run_pair_nodes_with_their_truth():
    mesh = ball_mesh(40.0, 30.0)
    rng = np.random.default_rng(5)
    u = 10 * rng.normal(size=mesh.points.shape)
    nodes = mesh.boundary[::-2]
    draws = u[nodes] + rng.normal(size=(2, 300, len(nodes), 3))
    posterior = xr.Dataset({"u_boundary": (("chain", "draw", "node", "axis"), draws)}, coords={"node": nodes})
    truth = Truth(u, np.ones(3), np.ones(3), 0.5 * u)
    run_metrics = metrics.compute_metrics(mesh, u + np.array([0.0, 0.6, 0.8]), truth, posterior, max_draws=200)
    assert run_metrics["coverage"]["0.5"] > 0.95
    assert run_metrics["boundary_error"]["posterior_mean"]["max"] == pytest.approx(1.0)
    assert run_metrics["mean_squared_error"]["posterior_mean"]["gm"] == pytest.approx(1.0)
    distance = np.linalg.norm(u[mesh.boundary], axis=1)
    assert run_metrics["boundary_error"]["unregistered"]["median"] == pytest.approx(np.median(distance))
    assert run_metrics["boundary_error"]["initial"]["max"] == pytest.approx(distance.max() / 2)
