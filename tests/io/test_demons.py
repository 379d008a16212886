"""Demons, on a phantom whose displacement is known."""

from __future__ import annotations

import numpy as np

from bayesreg.image import Image
from bayesreg.io.demons import find_demons
from tests.model.test_image_pose import FIXED, MASK


def test_demons_find_a_smooth_displacement_in_world_axes():
    """On a left-handed grid of 3 mm; less than half of a motion by as much is left, and each axis has its own."""
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    fixed = Image(FIXED.voxels, flip @ FIXED.affine)
    points = fixed.grid_points()

    def displacement(x):
        bump = np.exp(-((x / 40.0) ** 2).sum(-1))
        return bump[..., None] * np.array([4.0, -3.0, 2.0])

    x = points.copy()
    for _ in range(20):
        x = points - displacement(x)
    moving = fixed.with_voxels(np.asarray(fixed.interpolate(x, "cubic")))
    inside = points[np.asarray(MASK.voxels) != 0]
    estimate = np.stack([np.asarray(u.interpolate(inside)) for u in find_demons(fixed, moving)], axis=-1)
    true = displacement(inside)
    moved = np.linalg.norm(true, axis=-1) > 2
    residual = np.linalg.norm(estimate - true, axis=-1)[moved].mean()
    assert residual < np.linalg.norm(true[moved], axis=-1).mean() / 2
    for axis in range(3):
        assert np.polyfit(true[moved][:, axis], estimate[moved][:, axis], 1)[0] > 0.5
