"""The parts of the study of points: masks, rows of the table, and points predicted by all others."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from studies.points.left_out import predict_each
from studies.points.peers import Predicted, affine, rigid
from studies.points.runs import mask_of
from studies.points.table import Errors, describe, errors_of, pool

FIXED = np.random.default_rng(0).uniform(-30, 30, (12, 3))


def test_a_mask_is_the_hull_with_a_margin():
    corners = np.stack(np.meshgrid(*[[0.0, 40.0]] * 3), axis=-1).reshape(-1, 3)
    mask = mask_of(corners, 15.0)
    size = mask.affine[0, 0]
    # A cube with rounded edges: the cube, its faces, a quarter of a cylinder at each edge and a ball at the corners.
    volume = 40**3 + 6 * 40**2 * 15 + 3 * 40 * np.pi * 15**2 + 4 / 3 * np.pi * 15**3
    assert mask.voxels.sum() * size**3 == pytest.approx(volume, rel=0.06)
    assert not any(mask.voxels.take(end, axis).any() for axis in range(3) for end in (0, -1))


def test_each_point_is_predicted_without_itself():
    shift = FIXED @ Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix().T + 4.0 - FIXED
    np.testing.assert_allclose(predict_each(rigid, FIXED, shift).mean, shift, atol=1e-9)
    wrong = shift + np.array([50.0, 0.0, 0.0]) * (np.arange(12) == 3)[:, None]
    assert np.linalg.norm(predict_each(affine, FIXED, wrong).mean[3] - shift[3]) < 1e-9


def test_rows_pool_the_points_of_all_sets():
    truth = np.array([[0.5, 0.0, 0.0], [0.0, 9.0, 0.0]])
    predicted = Predicted(np.zeros((2, 3)), np.ones((2, 3)))
    both = pool([errors_of(predicted, truth, seconds) for seconds in (1.0, 3.0)])
    assert describe("a", "b", both) == "| a | b | 4.75 | 4.75 | 9.00 | 50.0% / 50.0% / 50.0% | 1.73 | 2 |"
    assert pool([errors_of(rigid(FIXED, FIXED, FIXED), FIXED, 1.0)]).covariance is None
    away = np.array([[3.0, 0.0, 4.0], [0.0, 0.0, 1.0]])
    row = describe("a", "b", Errors(away, np.stack([np.eye(3)] * 2), np.array([0.92, 0.3]), 7.0))
    assert row == "| a | b | 3.00 | 3.00 | 4.80 | 50.0% / 50.0% / 100.0% | 1.73 | 7 |"
