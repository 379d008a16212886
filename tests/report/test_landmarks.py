"""Landmarks in the report: how surprising each is, and what is said where nothing else determines it."""

import numpy as np
import pytest
from scipy import stats

from bayesreg.model.observations.landmarks_report import distance_figure, landmark_table, region_probability
from bayesreg.report.observations import _drawing
from tests.phantoms import box_mesh

MESH = box_mesh(2)


def summary(residual, covariance):
    """What three landmarks leave, left out with these results, or not left out."""
    arrays = {
        "names": np.array(["a", "b", "c"]),
        "points": MESH.points[:3],
        "sd": np.full(3, 0.5),
        "residual": np.full((3, 3), 0.1),
    }
    return arrays if residual is None else {**arrays, "left_out_residual": residual, "left_out_covariance": covariance}


def test_region_probability_is_uniform_where_the_covariance_is_right():
    rng = np.random.default_rng(0)
    root = np.tril(rng.normal(size=(3, 3))) + 2 * np.eye(3)
    levels = region_probability(rng.normal(size=(4000, 3)) @ root.T, np.broadcast_to(root @ root.T, (4000, 3, 3)))
    assert stats.kstest(levels, "uniform").pvalue > 1e-3


def test_what_was_left_out_is_counted():
    table = landmark_table("landmarks", summary(np.diag([0.1, 1.8, 9.0]), np.stack([np.eye(3)] * 3)))
    assert "mean is 3.63 mm" in table.caption
    assert (
        "33 % of the landmarks lie in their 50 % region, 67 % of the landmarks lie in their 95 % region"
        in table.caption
    )
    assert [row[0] for row in table.rows] == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("residual", "covariance", "sentence"),
    [
        (np.full((3, 3), np.nan), np.full((3, 3, 3), np.inf), "no landmark is determined by the other observations"),
        (None, None, "They were not left out in turn"),
    ],
)
def test_where_nothing_is_left_out_that_is_said(residual, covariance, sentence):
    arrays = summary(residual, covariance)
    table = landmark_table("landmarks", arrays)
    assert sentence in table.caption
    assert "nan" not in str(table)
    assert _drawing(distance_figure("landmarks", arrays)).uri.startswith("data:image/svg")
