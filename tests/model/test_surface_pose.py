"""The pose of an organ from points on its surface alone, against the motion that they were given."""

from __future__ import annotations

import numpy as np
import pytest

from bayesreg.image import Image
from bayesreg.model.observations.surface import Surface, SurfaceSection
from bayesreg.model.observations.surface_pose import find_pose
from bayesreg.pose import Motion
from bayesreg.types import InputError
from bayesreg.workflow.matching import match_pairs, match_surface
from tests.phantoms import box_mesh, of_one_tissue

HALF_AXES, BUMP = np.array([36.0, 26.0, 18.0]), np.array([30.0, 14.0, 8.0])


@pytest.fixture(scope="module")
def organ() -> Image:
    """An ellipsoid with a bump, which no turn maps onto itself."""
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = -60.0
    points = np.stack(np.meshgrid(*[np.arange(60)] * 3, indexing="ij"), axis=-1) @ affine[:3, :3] + affine[:3, 3]
    inside = ((points / HALF_AXES) ** 2).sum(axis=-1) < 1
    return Image((inside | (np.linalg.norm(points - BUMP, axis=-1) < 14)).astype(np.uint8), affine)


def surface_points(count: int, noise: float) -> np.ndarray:
    """Points on the surface, in closed form, with some wrong ones."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(6 * count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ellipsoid, ball = directions[::2] * HALF_AXES, BUMP + 14 * directions[1::2]
    kept = np.concatenate(
        [
            ellipsoid[np.linalg.norm(ellipsoid - BUMP, axis=1) > 14],
            ball[((ball / HALF_AXES) ** 2).sum(axis=1) > 1],
        ]
    )
    points = rng.permutation(kept)[:count] + noise * rng.normal(size=(count, 3))
    points[:: count // 10] += 15 * rng.normal(size=(len(points[:: count // 10]), 3))
    return points


@pytest.mark.parametrize("turn", [(20, -10, 15), (-30, 150, 60)])
def test_a_whole_surface_has_one_pose_wherever_it_lies(organ, turn):
    points = surface_points(500, 0.5)
    moved = Motion(np.array([220.0, -90.0, 40.0]), np.array(turn, float)).pose(np.zeros(3)).place(points)
    found = find_pose(Surface(moved), organ, ("organ",))
    apart = np.linalg.norm(found.pose.inverse.place(moved) - points, axis=1)
    assert np.median(apart) < 1.0
    assert found.lead > 5


def test_a_part_of_a_surface_has_several_and_the_user_is_told(organ):
    points = surface_points(2000, 0.5)
    patch = points[np.linalg.norm(points - [-20.0, 0.0, 18.0], axis=1) < 14]
    moved = Motion(np.array([60.0, 0.0, 0.0]), np.array([0.0, 70.0, 0.0])).pose(np.zeros(3)).place(patch)
    section = SurfaceSection.model_construct(name="surface", of="boundary")
    matched = match_surface(section, moved, organ, ("organ",))
    assert "another pose explains the points nearly as well" in matched.warnings[0]
    assert matched.notes[0].startswith("Pose: the coordinates of surface are")


@pytest.mark.parametrize("shift", [1500.0, 5000.0])
def test_a_tracker_may_be_far_away(organ, shift):
    points = surface_points(500, 0.5)
    moved = Motion(np.array([shift, 0.0, -200.0]), np.array([0.0, 40.0, 10.0])).pose(np.zeros(3)).place(points)
    found = find_pose(Surface(moved), organ, ("organ",))
    assert np.median(np.linalg.norm(found.pose.inverse.place(moved) - points, axis=1)) < 1.0


def test_pairs_tell_the_pose_of_any_motion(organ):
    points = surface_points(20, 0.0)
    pose = Motion(np.array([600.0, -90.0, 40.0]), np.array([-30.0, 150.0, 60.0])).pose(np.zeros(3))
    matched = match_pairs("landmarks", points, pose.place(points), organ)
    np.testing.assert_allclose(matched.matching.pose.matrix, pose.matrix, atol=1e-9)
    with pytest.raises(InputError, match="needs three pairs of points or more, got 2"):
        match_pairs("landmarks", points[:2], points[:2], organ)


def test_points_that_are_one_or_far_away_are_refused():
    with pytest.raises(InputError, match="expected 10 different points or more, got 1"):
        Surface(np.ones((30, 3)))
    mesh = of_one_tissue(box_mesh(2))
    with pytest.raises(InputError, match=r"half of its points lie more than \d+ mm away from the organ"):
        Surface(mesh.points + 300.0).on(mesh)
