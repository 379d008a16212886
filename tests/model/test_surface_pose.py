"""The pose of an organ from points on its surface alone, against the motion that they were given."""

from __future__ import annotations

import numpy as np
import pytest

from bayesreg.image import Image
from bayesreg.model.observations.surface import Surface, SurfaceSection
from bayesreg.model.observations.surface_pose import find_pose
from bayesreg.pose import Motion
from bayesreg.workflow.matching import match_surface

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
    assert found.gain > 5


def test_a_part_of_a_surface_has_several_and_the_user_is_told(organ):
    points = surface_points(2000, 0.5)
    patch = points[np.linalg.norm(points - [-20.0, 0.0, 18.0], axis=1) < 14]
    moved = Motion(np.array([60.0, 0.0, 0.0]), np.array([0.0, 70.0, 0.0])).pose(np.zeros(3)).place(patch)
    section = SurfaceSection.model_construct(name="surface", of="boundary")
    matched = match_surface(section, moved, organ, ("organ",))
    assert "another pose explains the points nearly as well" in matched.warnings[0]
    assert matched.notes[0].startswith("Pose: the organ lies")
