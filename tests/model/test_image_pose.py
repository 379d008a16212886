"""The pose of a pair of images, on a phantom whose motion is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.model.observations.images.image_pose import WIDE, find_poses
from bayesreg.pose import Motion, Pose
from bayesreg.types import InputError

# mm
EDGE = 3.0


def organ():
    """A lopsided body with bright and dark parts, on a grid of 3 mm, and its mask."""
    rng = np.random.default_rng(0)
    shape = (50, 56, 46)
    x = np.stack(np.meshgrid(*(EDGE * (np.arange(n) - n / 2) for n in shape), indexing="ij"), axis=-1)
    inside = ((x / (52.0, 66.0, 45.0)) ** 2).sum(-1) < 1
    inside &= ((x - (40.0, 30.0, 20.0)) ** 2).sum(-1) > 20**2
    texture = ndimage.gaussian_filter(rng.normal(size=shape), 2.5)
    voxels = inside * (1 + 8 * texture)
    affine = np.diag([EDGE, EDGE, EDGE, 1.0])
    affine[:3, 3] = -EDGE * np.array(shape) / 2
    return Image(voxels, affine), Image(inside.astype(np.uint8), affine)


FIXED, MASK = organ()
# The size of the body relative to a brain.
SIZE = 0.75


def motion(millimetres, degrees, seed=0):
    rng = np.random.default_rng(seed)
    axis, shift = (way / np.linalg.norm(way) for way in rng.normal(size=(2, 3)))
    return Motion(millimetres * shift, degrees * axis).pose(np.zeros(3))


def moved(pose, values=lambda v: v):
    """The same body elsewhere: on the grid of the moving image as it was, by its header alone."""
    noise = np.random.default_rng(1).normal(scale=0.02, size=FIXED.shape)
    return pose.inverse.aligned(FIXED.with_voxels(values(np.asarray(FIXED.voxels)) + noise))


def off(estimate, pose):
    points = MASK.voxel_to_world(np.argwhere(np.asarray(MASK.voxels)))
    return np.linalg.norm(estimate.place(points) - pose.place(points), axis=1).mean()


@pytest.mark.parametrize(
    ("millimetres", "degrees"),
    [(8.0, 8.0), pytest.param(20.0, 15.0, marks=pytest.mark.long), pytest.param(300.0, 20.0, marks=pytest.mark.long)],
)
def test_a_rigid_motion_is_found(millimetres, degrees):
    pose = motion(millimetres, degrees)
    poses = find_poses(FIXED, moved(pose), MASK, SIZE)
    assert off(poses.best.pose, pose) < 0.3
    assert poses.best.evidence > poses.headers.evidence + 10


@pytest.mark.long
def test_it_is_found_where_bright_and_dark_change_places():
    pose = motion(8.0, 8.0, seed=2)
    inverted = moved(pose, lambda v: np.where(v > 0, 2 - v, 0.0))
    assert off(find_poses(FIXED, inverted, MASK, SIZE).best.pose, pose) < 0.3


def test_images_that_lie_on_one_another_stay():
    poses = find_poses(FIXED, moved(Pose.identity()), MASK, SIZE)
    assert off(poses.best.pose, Pose.identity()) < 0.1
    assert poses.best.evidence < poses.headers.evidence + 5


def test_what_is_ignored_does_not_mislead():
    """A bright part of the moving image that is elsewhere in the fixed one."""
    pose = motion(8.0, 8.0, seed=3)
    moving = moved(pose)
    voxels = np.array(moving.voxels)
    voxels[10:25, 10:40, 8:40] = 3 * ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(15, 30, 32)), 1)
    ignored = np.zeros(moving.shape, np.uint8)
    ignored[10:25, 10:40, 8:40] = 1
    poses = find_poses(FIXED, moving.with_voxels(voxels), MASK, SIZE, moving_ignore=moving.with_voxels(ignored))
    assert off(poses.best.pose, pose) < 0.3


@pytest.mark.long
def test_a_mask_of_a_small_grid_ignores_what_it_holds_alone():
    """In both images, and what is bright there, such as metal, has no say."""
    pose = motion(8.0, 8.0, seed=3)
    moving = moved(pose)
    block = np.s_[20:28, 20:28, 18:26]
    inside = np.zeros(moving.shape, bool)
    inside[block] = True
    cropped = moving.with_voxels(inside.astype(np.uint8)).affine.copy()
    cropped[:3, 3] = moving.voxel_to_world(np.array([20.0, 20.0, 18.0]))
    mask = Image(np.ones((8, 8, 8), np.uint8), cropped)
    bright = moving.with_voxels(np.where(inside, 1e4, moving.voxels))
    assert off(find_poses(FIXED, bright, MASK, SIZE, moving_ignore=mask).best.pose, pose) < 0.3
    metal = FIXED.with_voxels(np.where(inside, 1e4, FIXED.voxels))
    mask = Image(mask.voxels, np.c_[FIXED.affine[:, :3], [*FIXED.voxel_to_world(np.array([20.0, 20.0, 18.0])), 1.0]])
    assert off(find_poses(metal, moving, MASK, SIZE, fixed_ignore=mask).best.pose, pose) < 0.3


@pytest.mark.long
def test_the_same_images_give_the_same_pose():
    moving = moved(motion(8.0, 8.0))
    first_matrix, second_matrix = (find_poses(FIXED, moving, MASK, SIZE).best.pose.matrix for _ in range(2))
    np.testing.assert_array_equal(first_matrix, second_matrix)


@pytest.mark.long
def test_a_turned_header_is_found_where_the_pose_is_unknown():
    """By 180° about one axis, as where the axes of a header are mistaken."""
    pose = Motion(np.array([5.0, -8.0, 3.0]), np.array([0.0, 0.0, 180.0])).pose(np.zeros(3))
    poses = find_poses(FIXED, moved(pose), MASK, SIZE, prior=WIDE, in_all_directions=True)
    assert off(poses.best.pose, pose) < 0.3


@pytest.mark.long
def test_no_pose_gains_by_leaving_the_view():
    """A wedge of the phantom, with a constant filling around it, and noise elsewhere in common with nothing."""
    moving = moved(motion(6.0, 6.0, seed=4))
    points = moving.grid_points()
    seen = (points[..., 2] > 0.4 * np.abs(points[..., 0])) & (points[..., 1] < 30)
    wedge = moving.with_voxels(np.where(seen, moving.voxels, 0.0))
    poses = find_poses(FIXED, wedge, MASK, SIZE)
    assert off(poses.best.pose, motion(6.0, 6.0, seed=4)) < 1.0
    noise = np.random.default_rng(8).normal(size=moving.shape)
    poses = find_poses(FIXED, moving.with_voxels(np.where(seen, noise, 0.0)), MASK, SIZE)
    assert poses.best.seen > poses.headers.seen / 2


def test_an_image_that_shows_nothing_is_refused():
    with pytest.raises(InputError, match="shows nothing"):
        find_poses(FIXED, FIXED.with_voxels(np.ones(FIXED.shape)), MASK, SIZE)
