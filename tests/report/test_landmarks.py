"""Landmarks in the report: how surprising each is, and what is said where nothing else determines it."""

import numpy as np
import pytest
from scipy import stats

from bayesreg.model.observations.landmarks_report import (
    describe_readings,
    distance_figure,
    doubt_intervals,
    landmark_table,
    region_probability,
)
from bayesreg.report.observations import _drawing
from tests.phantoms import box_mesh

MESH = box_mesh(2)


def summary(residual=None, share=None):
    """What three landmarks, or as many as there are shares, leave: left out with these results, or not left out."""
    count = 3 if share is None else len(share)
    arrays = {
        "names": np.arange(count).astype(str),
        "points": MESH.points[np.arange(count) % len(MESH.points)],
        "sd": np.full(count, 0.5),
        "residual": np.full((count, 3), 0.1),
    }
    return arrays if residual is None else {**arrays, "left_out_residual": residual, "left_out_share": share}


def test_region_probability_is_uniform_where_the_covariance_is_right():
    rng = np.random.default_rng(0)
    root = np.tril(rng.normal(size=(3, 3))) + 2 * np.eye(3)
    levels = region_probability(rng.normal(size=(4000, 3)) @ root.T, np.broadcast_to(root @ root.T, (4000, 3, 3)))
    assert stats.kstest(levels, "uniform").pvalue > 1e-3


def test_what_was_left_out_is_counted():
    table = landmark_table("landmarks", summary(np.diag([0.1, 1.8, 9.0]), np.array([0.003, 0.93, 1.0])))
    assert "mean is 3.63 mm" in table.caption
    expected = (
        "Of 3 landmarks, each predicted from the others, 1 lie in their 50 %, 1 lie in their 90 %, 2 lie in their 95 % "
    )
    assert expected in table.caption
    assert "Chance allows such numbers" in table.caption
    assert [row[0] for row in table.rows] == ["0", "1", "2"]


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
    ("power", "sentence"),
    [
        (1.0, None),
        (0.3, "so few would lie in their regions of 50 % and 90 % and 95 % less than once in a hundred times: the "),
        (3.0, "so many would lie in their regions of 50 % less than once in a hundred times: the intervals are too c"),
    ],
)
def test_intervals_are_judged_by_what_chance_allows(power, sentence):
    """Shares that are uniform, and others: of 100, chance lets 37 to 63 lie in their regions of 50 %."""
    share = np.linspace(0.005, 0.995, 100) ** power
    doubts = doubt_intervals("landmarks", summary(np.ones((100, 3)), share))
    assert len(doubts) == (sentence is not None)
    assert all(sentence in doubt and doubt.startswith("landmarks: Of 100 landmarks") for doubt in doubts)


@pytest.mark.parametrize(("held", "doubts"), [(36, 1), (37, 0), (63, 0), (64, 1)])
def test_the_limits_of_chance_are_those_of_the_binomial_distribution(held, doubts):
    tail = 2 * stats.binom(100, 0.5).cdf(min(held, 100 - held))
    assert (tail < 0.01) == bool(doubts)
    # 93 and 96 in the wider regions are as they should be.
    share = np.r_[np.full(held, 0.2), np.full(93 - held, 0.8), np.full(3, 0.92), np.full(4, 0.99)]
    assert len(doubt_intervals("landmarks", summary(np.ones((100, 3)), share))) == doubts


@pytest.mark.parametrize(
    ("residual", "share", "sentence"),
    [
        (np.full((3, 3), np.nan), np.full(3, np.nan), "no landmark is determined by the other observations"),
        (None, None, "They were not left out in turn"),
    ],
)
def test_where_nothing_is_left_out_that_is_said(residual, share, sentence):
    arrays = summary(residual, share)
    table = landmark_table("landmarks", arrays)
    assert sentence in table.caption
    assert "nan" not in str(table)
    assert _drawing(distance_figure("landmarks", arrays)).uri.startswith("data:image/svg")
