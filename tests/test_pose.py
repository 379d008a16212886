"""Rigid motions between the worlds of two images."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayesreg.image import Image
from bayesreg.pose import Motion, Pose, compose, rigid_projection


def motion(seed, degrees=15.0, millimetres=20.0):
    rng = np.random.default_rng(seed)
    axis, shift = (way / np.linalg.norm(way) for way in rng.normal(size=(2, 3)))
    return Motion(millimetres * shift, degrees * axis).pose(np.zeros(3))


def points(count=50):
    return np.random.default_rng(9).normal(scale=40.0, size=(count, 3)) + np.array([10.0, -20.0, 5.0])


def test_an_aligned_image_has_at_a_point_what_it_had_where_the_pose_takes_the_point():
    pose, rng = motion(0), np.random.default_rng(1)
    image = Image(rng.normal(size=(9, 10, 11)), np.diag([-6.0, 5.0, 7.0, 1.0]))
    inside = pose.inverse.place(image.voxel_to_world(rng.uniform(1, 7, size=(30, 3))))
    interpolated = pose.aligned(image).interpolate(inside)
    np.testing.assert_allclose(interpolated, image.interpolate(pose.place(inside)), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_six_numbers_about_a_point_are_the_motion(seed):
    pose, centre = motion(seed, degrees=170.0), np.array([5.0, -6.0, 7.0])
    np.testing.assert_allclose(pose.about(centre).pose(centre).matrix, pose.matrix, atol=1e-9)


def test_the_rigid_part_of_a_displacement_is_its_least_squares_fit():
    """Least squares by NumPy over six modes, and beside a displacement that is rigid itself."""
    rng, positions = np.random.default_rng(4), points()
    weights = rng.uniform(0.5, 2, len(positions))
    centre, projection = rigid_projection(positions, weights)
    u = rng.normal(size=positions.shape)
    turns = np.stack([np.cross(axis, positions - centre) for axis in np.eye(3)], axis=-1)
    modes = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=-1)
    root = np.sqrt(weights)[:, None, None]
    expected = np.linalg.lstsq((root * modes).reshape(-1, 6), (root[..., 0] * u).ravel(), rcond=None)[0]
    np.testing.assert_allclose(np.einsum("aki,ki->a", projection, u), expected, atol=1e-12)


def test_a_pose_and_small_motions_before_it_make_one_motion():
    pose, small, centre = motion(5), np.array([[0.3, -0.2, 0.1, 0.01, 0.02, -0.01]]), np.array([5.0, 6.0, 7.0])
    first = np.eye(4)
    first[:3, :3] = Rotation.from_rotvec(small[0, 3:]).as_matrix()
    first[:3, 3] = centre + small[0, :3] - first[:3, :3] @ centre
    expected = Pose(pose.matrix @ first).about(centre)
    composed = compose(pose, centre, small)
    np.testing.assert_allclose(composed.translation[0], expected.translation, atol=1e-12)
    np.testing.assert_allclose(composed.rotation[0], expected.rotation, atol=1e-9)


def test_displacements_count_from_the_fixed_world_to_the_moving_one():
    pose, positions, u = motion(6), points(), np.random.default_rng(7).normal(size=(50, 3))
    np.testing.assert_allclose(positions + pose.displacement(positions, u), pose.place(positions + u))
    assert pose.about(np.zeros(3)).degrees == pytest.approx(15.0)
    assert pose.about(np.zeros(3)).millimetres == pytest.approx(20.0)
