"""The posterior of a transform: against closed forms, against brute force, and how often it holds the truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from bayesreg.fem.deformation import Deformer
from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model.submesh import Unresolved, unresolved_displacement
from bayesreg.pose import Motion
from bayesreg.results.carried_labels import carry_labels
from bayesreg.results.transform import Transform, distances_of, spread
from tests.phantoms import ball_mesh

CENTRE = np.array([5.0, -3.0, 8.0])
POSE = Motion(np.array([12.0, -3.0, 5.0]), np.array([4.0, 10.0, -6.0])).pose(CENTRE)


def _transform(draws: int = 40, sd: float = 0.3, seed: int = 0) -> Transform:
    mesh, rng = ball_mesh(radius=38, spacing=18.0), np.random.default_rng(seed)
    x, y, z = (mesh.points - CENTRE).T / 25
    u = 2.0 * np.stack([np.sin(y), np.cos(z) - 1, x * y], axis=1)
    return Transform(Deformer(mesh), POSE, u, u + sd * rng.standard_normal((draws, *u.shape)), _unresolved(mesh))


def _unresolved(mesh: TetMesh, size: float = 0.1) -> Unresolved:
    cells = np.ones(len(mesh.cells))
    return unresolved_displacement(mesh, 5 * cells, cells, size, 2 * size, np.ones(len(mesh.points)))


def _points(transform: Transform, count: int, radius: float, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    away = rng.normal(size=(count, 3))
    away *= radius * rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(away, axis=1, keepdims=True)
    return CENTRE + away


def test_there_and_back():
    transform = _transform()
    points = _points(transform, 2000, 60.0)
    placed, location = transform.place(points)
    assert 0.2 < transform.deformer.is_inside(location).mean() < 0.4
    restored, _ = transform.inverse.place(placed)
    np.testing.assert_allclose(restored, points, atol=1e-9)
    inside = transform.deformer.is_inside(location)
    u = transform.mean.displacement(points[inside], transform.deformer.locate(points[inside]))
    np.testing.assert_allclose(placed[inside], transform.pose.place(points[inside] + u), atol=1e-12)


def test_the_covariance_is_that_of_the_draws_turned_with_the_pose():
    """Of draws that shift the whole mesh, and of what the mesh cannot resolve."""
    mesh = ball_mesh(radius=38, spacing=18.0)
    u = 0.02 * (mesh.points - CENTRE)
    sd = np.array([0.1, 0.2, 0.4])
    draws = u + sd * np.random.default_rng(0).standard_normal((2000, 1, 3))
    rigid = Transform(Deformer(mesh), POSE, u, draws, _unresolved(mesh, size=0.0))
    transform = replace(rigid, unresolved=_unresolved(mesh, size=3.0))
    points = _points(transform, 200, 25.0)
    alone, both = spread(rigid, points).covariance, spread(transform, points).covariance
    location = transform.deformer.locate(points)
    beside = transform.unresolved.turned(POSE.rotation).covariance_at(location.cell, location.barycentric)
    assert np.trace(beside, axis1=1, axis2=2).mean() > 0.05
    np.testing.assert_allclose(both - alone, beside, atol=0.25 * beside.max())
    np.testing.assert_allclose((both - alone).mean(axis=0), beside.mean(axis=0), atol=0.04 * beside.max())
    turned = np.einsum("ij,kjl,ml->kim", POSE.rotation, transform.covariance(location), POSE.rotation)
    np.testing.assert_allclose(both, turned, atol=0.15 * turned.max())
    uncertainty = spread(rigid, points, far=(0.5, 1.0))
    assert uncertainty.inside.all()
    expected = POSE.rotation @ np.diag(sd**2) @ POSE.rotation.T
    np.testing.assert_allclose(uncertainty.covariance.mean(axis=0), expected, atol=0.004)
    np.testing.assert_allclose(
        uncertainty.covariance, np.broadcast_to(expected, uncertainty.covariance.shape), atol=0.03
    )
    lengths, axes = uncertainty.ellipsoids(0.95)
    np.testing.assert_allclose(lengths.mean(axis=0), np.sqrt(chi2.ppf(0.95, 3)) * sd[::-1], rtol=0.05)
    np.testing.assert_allclose(np.abs(axes[:, 0] @ POSE.rotation[:, 2]), 1, atol=0.02)
    drawn = np.linalg.norm(sd * np.random.default_rng(1).standard_normal((100_000, 3)), axis=1)
    for share, distance in zip(uncertainty.far, (0.5, 1.0), strict=True):
        assert share.mean() == pytest.approx((drawn > distance).mean(), abs=0.01)


def test_the_inverse_spreads_as_far():
    transform = _transform(draws=300)
    points = _points(transform, 300, 25.0)
    forward = spread(transform, points)
    inverse = spread(transform.inverse, forward.places)
    np.testing.assert_allclose(inverse.places, points, atol=1e-9)
    forward_sd, inverse_sd = (
        np.sqrt(np.trace(uncertainty.covariance, axis1=1, axis2=2)) for uncertainty in (forward, inverse)
    )
    assert np.median(inverse_sd / forward_sd) == pytest.approx(1, abs=0.1)


def test_around_the_mesh_is_told():
    transform = _transform(draws=5)
    uncertainty = spread(transform, CENTRE + np.array([[0.0, 0, 0], [60, 0, 0], [300, 0, 0]]))
    assert uncertainty.inside.tolist() == [True, False, False]
    assert np.isfinite(uncertainty.places).all()


def test_folded_draws_are_counted():
    transform = _transform(draws=10, sd=0.0)
    bad = transform.draws.copy()
    node = transform.mesh.interior[0]
    bad[3, node] += 40.0
    assert replace(transform, draws=bad).folded == pytest.approx(0.1)


def _labels(seed: int = 0) -> Image:
    """Three labels, one of them a ball; 3 mm voxels on a left-handed grid."""
    affine = np.diag([-3.0, 3.0, 3.0, 1.0])
    affine[:3, 3] = CENTRE + np.array([48.0, -48.0, -48.0])
    grid = Image(np.zeros((33, 33, 33), np.int32), affine)
    away = grid.grid_points() - CENTRE
    radius = np.linalg.norm(away, axis=-1)
    return grid.with_voxels(np.select([radius < 12, radius < 30, radius < 44], [70, 2, 5], 0).astype(np.int32))


@pytest.mark.parametrize("turned", [False, True])
def test_label_probabilities_are_those_of_brute_force(turned):
    transform = _transform(draws=12, sd=0.8)
    transform = transform.inverse if turned else transform
    labels = _labels()
    grid = Image(np.zeros((20, 21, 22)), transform.pose.matrix @ labels.affine @ np.diag([1.7, 1.6, 1.5, 1.0]))
    if turned:
        grid = Image(grid.voxels, labels.affine @ np.diag([1.7, 1.6, 1.5, 1.0]))
        labels = Image(labels.voxels, transform.pose.matrix @ labels.affine)
    carried = carry_labels(transform, labels, grid)
    assert 0.02 < len(carried.open) / len(carried.certain) < 0.9
    inverse, places = transform.inverse, grid.grid_points().reshape(-1, 3)
    _, near = inverse.place(places)
    # Every voxel by every draw; what the mesh cannot resolve moves the open voxels alone.
    open_near = type(near)(near.cell[carried.open], near.barycentric[carried.open])
    sd = inverse.averaged_sd(open_near)
    brute = {value: np.zeros(len(places)) for value in (2, 5, 70)}
    for draw, u in enumerate(inverse.draws):
        if inverse.turned:
            source = inverse.deformer.displaced(u).sources(inverse.pose.inverse.place(places))[0]
        else:
            source = inverse.pose.place(places + inverse.deformer.displaced(u).displacement(places, near))
        source[carried.open] = inverse.place_by(draw, places[carried.open], open_near, sd)
        for value, count in brute.items():
            count += labels.nearest(source) == value
    for value, probability in carried.probabilities():
        # Float32 of the spread between nodes decides where a source lies on the border of two voxels.
        away = np.abs(probability.ravel() - brute[value] / 12)
        assert (away > 1e-6).mean() < 1e-3
    assert set(np.unique(carried.most_probable.voxels)) <= {0, 2, 5, 70}
    total = sum(probability for _, probability in carried.probabilities())
    assert total.max() <= 1 + 1e-6


def test_labels_around_the_mesh_can_be_left_out():
    transform, labels = _transform(draws=6), _labels()
    grid = Image(np.zeros((20, 20, 20)), transform.pose.matrix @ labels.affine @ np.diag([1.65, 1.65, 1.65, 1.0]))
    with_surroundings, alone = (carry_labels(transform, labels, grid, keep_around=keep) for keep in (True, False))
    inside = transform.inverse.place(grid.grid_points().reshape(-1, 3))[1]
    in_mesh = transform.deformer.is_inside(inside).reshape(grid.shape)
    for (_, probability), (_, probability_alone) in zip(
        with_surroundings.probabilities(), alone.probabilities(), strict=True
    ):
        np.testing.assert_array_equal(np.isnan(probability_alone), ~in_mesh)
        # Other Normal numbers, of six draws.
        assert abs((probability - probability_alone)[in_mesh].mean()) < 0.01
    assert (np.asarray(alone.most_probable.voxels)[~in_mesh] == 0).all()
    assert (np.asarray(with_surroundings.most_probable.voxels)[~in_mesh] != 0).any()


CASES, LEVELS = 150, (0.5, 0.9, 0.95)


def _normal(size, rng, mesh, sd: float = 0.8, reach: float = 25.0):
    """Displacements with a covariance that falls off with distance."""
    gap = np.linalg.norm(mesh.points[:, None] - mesh.points, axis=-1)
    root = np.linalg.cholesky(sd**2 * np.exp(-gap / reach) + 1e-9 * np.eye(len(gap)))
    return np.einsum("nm,smi->sni", root, rng.standard_normal((size, len(gap), 3)))


@pytest.mark.long
def test_ellipsoids_and_labels_hold_the_truth_as_often_as_they_say():
    """Truths and draws of one distribution: one point and one voxel of each case count, within 3 binomial errors."""
    mesh = ball_mesh(radius=38, spacing=24.0)
    rng, labels, deformer = np.random.default_rng(5), _labels(), Deformer(mesh)
    mean = np.zeros(mesh.points.shape)
    hits, calibrated = np.zeros((2, len(LEVELS))), []
    for _ in range(CASES):
        *draws, u = _normal(201, rng, mesh)
        transform = Transform(deformer, POSE, mean, np.array(draws), _unresolved(mesh))
        start = CENTRE + rng.uniform(-12, 12, (1, 3))
        for row, way in enumerate((transform, transform.inverse)):
            points = start if row == 0 else POSE.place(start)
            uncertainty = spread(way, points)
            away = _true_place(way, points, u, rng)[0] - uncertainty.places[0]
            square = away @ np.linalg.solve(uncertainty.covariance[0], away)
            hits[row] += [square <= chi2.ppf(level, 3) for level in LEVELS]
        grid = Image(np.zeros((1, 1, 1)), _at(POSE.place(CENTRE + rng.uniform(-15, 15, 3))))
        carried = carry_labels(transform, labels, grid)
        source = _true_place(transform.inverse, grid.grid_points().reshape(-1, 3), u, rng)
        true = labels.nearest(source)[0]
        calibrated += [(float(share.item()), float(true == value)) for value, share in carried.probabilities()]
    for level, share in zip(LEVELS, hits.T / CASES, strict=True):
        assert np.abs(share - level).max() < 3 * np.sqrt(level * (1 - level) / CASES), hits / CASES
    # Sum of Bernoulli variables of the probabilities told.
    probabilities, happened = np.array(calibrated).T
    spread_of_sum = np.sqrt((probabilities * (1 - probabilities)).sum())
    assert spread_of_sum > 2
    assert abs((happened - probabilities).sum()) < 3 * spread_of_sum
    middle = (probabilities > 0.1) & (probabilities < 0.9)
    assert middle.sum() > 20
    assert (
        abs((happened - probabilities)[middle].mean())
        < 3 * np.sqrt((probabilities * (1 - probabilities))[middle].sum()) / middle.sum()
    )


def _true_place(way, points, u, rng):
    """By a displacement and what the mesh does not resolve of it."""
    _, near = way.place(points)
    drawn = way.unresolved.draw((int(rng.integers(2**32)),))
    beside = way.unresolved.displacement(drawn, near.cell, near.barycentric)
    beside += way.averaged_sd(near) * rng.standard_normal(points.shape)
    displaced = way.deformer.displaced(u)
    if way.turned:
        return displaced.sources(way.pose.inverse.place(points))[0] - beside
    return way.pose.place(points + displaced.displacement(points, near) + beside)


def _at(place):
    affine = np.eye(4)
    affine[:3, 3] = place
    return affine


def test_a_mesh_alone_is_enough():
    """No more than arrays is needed to move points by a displacement of one's own."""
    ball = ball_mesh(spacing=24.0)
    mesh = TetMesh.from_arrays(ball.points, ball.cells, np.zeros(len(ball.cells), int), ("all",))
    u = np.ones(mesh.points.shape)
    points = mesh.points[:3]
    deformer = Deformer(mesh)
    np.testing.assert_allclose(deformer.displaced(u).displacement(points, deformer.locate(points)), 1, atol=1e-9)


@pytest.mark.parametrize("sd", [(1.0, 1.0, 1.0), (3.0, 0.5, 0.2), (1.0, 1.0, 0.01), (2.0, 1.0, 0.5)])
def test_distances_of_normal_vectors_are_those_of_drawn_ones(sd):
    turn = POSE.rotation
    covariance = (turn @ np.diag(np.square(sd)) @ turn.T)[None]
    drawn = np.linalg.norm(np.random.default_rng(0).standard_normal((200_000, 3)) * sd, axis=1)
    distances = (0.3, 0.5, 1.0, 2.0, 4.0)
    uncertainty = distances_of(np.concatenate([covariance, covariance * np.nan]), distances)
    for share, distance in zip(uncertainty.far, distances, strict=True):
        assert share[0] == pytest.approx((drawn > distance).mean(), abs=0.01)
    assert uncertainty.radius[0] == pytest.approx(np.quantile(drawn, 0.95), rel=0.02)
    assert np.isnan([uncertainty.radius[1], *uncertainty.far[:, 1]]).all()


def test_the_covariance_in_closed_form_is_that_of_the_draws():
    transform = _transform(draws=400)
    points = _points(transform, 200, 28.0)
    uncertainty = spread(transform, points)
    _, near = transform.place(points)
    closed = POSE.rotation @ transform.covariance(near) @ POSE.rotation.T
    sd, drawn = (np.sqrt(np.einsum("kii->ki", covariance)) for covariance in (closed, uncertainty.covariance))
    np.testing.assert_allclose(drawn, sd, rtol=0.15)
    assert np.mean(drawn / sd) == pytest.approx(1, abs=0.01)
