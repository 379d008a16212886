"""Landmarks in the report: how surprising each is, and what is said where nothing else determines it."""

import numpy as np
import pytest
from scipy import stats

from bayesreg.model.observations.landmarks_report import (
    describe_readings,
    distance_figure,
    landmark_table,
    region_probability,
)
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


def test_both_sds_are_told_where_points_were_read_twice():
    arrays = summary(None, None) | {"reading_sd": np.array([0.2, 0.3, 0.5]), "inferred_sd": np.array([0.4, 0.3, 1.2])}
    (sentence,) = describe_readings("landmarks", arrays)
    assert "has an sd of 0.2 mm along x, 0.3 mm along y, 0.5 mm along z by both" in sentence
    assert "the run infers 0.4 mm along x, 0.3 mm along y, 1.2 mm along z" in sentence
    (sentence,) = describe_readings("landmarks", arrays | {"inferred_sd": np.full(3, np.nan)})
    assert "infers" not in sentence
    assert describe_readings("landmarks", summary(None, None)) == []
    # The figure takes what belongs to each point.
    many = arrays | {name: np.repeat(values, 2, axis=0) for name, values in summary(None, None).items()}
    assert _drawing(distance_figure("landmarks", many)).uri.startswith("data:image/svg")


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
