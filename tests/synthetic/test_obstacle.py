"""The smoothed skull: its gradient, and a flat wall that smoothing leaves alone."""

import numpy as np

from bayesreg.image import Image
from bayesreg.synthetic.obstacle import SmoothObstacle
from tests.phantoms import flat_skull, rotated_affine

CORNERS = np.array([[-20.0, -20, -20], [20, 20, 20]])


def test_a_flat_wall_stays_where_it_is():
    obstacle = SmoothObstacle(flat_skull(CORNERS, axis=1, wall=12.0), smoothing_mm=2.0)
    points = np.random.default_rng(0).uniform([-15, -6, -15], [15, 18, 15], (200, 3))
    points = points[np.abs(points[:, 1] - 12) > 9]
    gap, gradient = obstacle(points)
    np.testing.assert_allclose(gap, 12 - points[:, 1], atol=2e-3)
    np.testing.assert_allclose(gradient, np.tile([0, -1, 0], (len(points), 1)), atol=2e-3)
    np.testing.assert_allclose(obstacle.distance(points), 12 - points[:, 1], atol=1e-9)


def test_the_gradient_is_that_of_the_value_on_a_rotated_left_handed_grid():
    shape = (24, 19, 28)
    empty = Image(np.zeros(shape), rotated_affine(CORNERS, shape))
    outside = np.linalg.norm(empty.grid_points(), axis=-1) > 18
    obstacle = SmoothObstacle(empty.with_voxels(outside.astype(float)), smoothing_mm=1.5)
    points = np.random.default_rng(1).uniform(-14, 14, (50, 3))
    _, gradient = obstacle(points)
    steps = 1e-4 * np.eye(3)
    numeric = np.stack([(obstacle(points + h)[0] - obstacle(points - h)[0]) / 2e-4 for h in steps], axis=1)
    np.testing.assert_allclose(gradient, numeric, atol=1e-7)


def test_beyond_the_grid_the_way_back_is_downhill():
    empty = Image(np.zeros((20, 20, 20)), np.diag([2.0, 2.0, 2.0, 1.0]))
    obstacle = SmoothObstacle(empty, smoothing_mm=2.0)
    below = np.array([[19.0, 19.0, z] for z in (-9.0, -6.0)])
    gap, gradient = obstacle(below)
    np.testing.assert_allclose(gap, below[:, 2] + 1, atol=0.05)
    np.testing.assert_allclose(gradient, np.tile([0, 0, 1], (2, 1)), atol=0.05)
    np.testing.assert_allclose(obstacle.distance(below), below[:, 2] + 1, atol=1e-9)
