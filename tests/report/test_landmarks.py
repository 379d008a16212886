"""Landmarks in the report: how surprising each is, and what is said where nothing else determines it."""

import numpy as np
import pytest
from scipy import stats

from bayesreg.report.landmarks import landmark_table, residuals, surprise
from tests.report.conftest import make_study


@pytest.fixture(scope="module")
def study():
    return make_study(draws=20, spacing=24.0)


def observed(study, residual, covariance):
    """Predictions with three landmarks, left out with these results, or not left out."""
    return study.run.predicted._replace(
        landmark_names=np.array(["a", "b", "c"]),
        landmark_points=study.run.mesh.points[:3],
        landmark_sd=np.full(3, 0.5),
        landmark_residual=np.full((3, 3), 0.1),
        left_out_residual=residual,
        left_out_covariance=covariance,
    )


def test_surprise_is_uniform_where_the_covariance_is_right():
    rng = np.random.default_rng(0)
    root = np.tril(rng.normal(size=(3, 3))) + 2 * np.eye(3)
    levels = surprise(rng.normal(size=(4000, 3)) @ root.T, np.broadcast_to(root @ root.T, (4000, 3, 3)))
    assert stats.kstest(levels, "uniform").pvalue > 1e-3


def test_what_was_left_out_is_counted(study):
    table = landmark_table(study.run.mesh, observed(study, np.diag([0.1, 1.8, 9.0]), np.stack([np.eye(3)] * 3)))
    assert "mean is 3.63 mm" in table.caption
    assert (
        "33 % of the landmarks lie in their 50 % region, 67 % of the landmarks lie in their 95 % region"
        in table.caption
    )
    assert [row[0] for row in table.groups[0][1]] == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("residual", "covariance", "said"),
    [
        (np.full((3, 3), np.nan), np.full((3, 3, 3), np.inf), "no landmark is determined by the other observations"),
        (None, None, "They were not left out in turn"),
    ],
)
def test_where_nothing_is_left_out_that_is_said(study, residual, covariance, said):
    predicted = observed(study, residual, covariance)
    table = landmark_table(study.run.mesh, predicted)
    assert said in table.caption
    assert "nan" not in str(table)
    assert residuals(predicted).uri.startswith("data:image/webp")
