"""Landmarks that were held out: those outside the mesh count nowhere, and probabilities that are right look so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesreg.report.evaluation import evaluation, evaluation_table
from bayesreg.report.study import Study


@pytest.fixture
def held_out(study):
    """Predictions with landmarks whose errors follow their covariance; a function of which lie in the mesh."""

    def of(inside):
        rng, count = np.random.default_rng(0), len(inside)
        residual = rng.normal(size=(count, 3)) * 0.5
        covariance = np.where(np.reshape(inside, (-1, 1, 1)), 0.25 * np.eye(3), np.nan)
        predicted = study.run.predicted._replace(
            evaluation_names=np.arange(count).astype(str),
            evaluation_points=np.zeros((count, 3)),
            evaluation_before=np.full(count, 9.0),
            evaluation_posed=np.full(count, 4.0),
            evaluation_residual=np.where(np.reshape(inside, (-1, 1)), residual, 50.0),
            evaluation_covariance=covariance,
            evaluation_inside=np.asarray(inside),
        )
        return Study(replace(study.run, predicted=predicted), *study[1:])

    return of


def test_landmarks_outside_the_mesh_are_left_out_and_told(held_out):
    table = evaluation_table(held_out([True] * 400 + [False] * 3))
    ((_, rows),) = table.groups
    assert rows[0][1:] == ["9.00"] * 4
    after = [float(value) for value in rows[2][1:]]
    # The length of a Normal vector of sd 0.5: mean 0.798, 95 % 1.40.
    assert after[0] == pytest.approx(0.798, abs=0.05)
    assert after[2] == pytest.approx(1.40, abs=0.15)
    assert "400 landmarks lie in the moving image" in table.caption
    assert "3 more lie outside the mesh" in table.caption
    shares = [float(word) for word in table.caption.split() if word.isdecimal()]
    assert np.abs(np.array(shares[1:6:2]) - (50, 90, 95)).max() < 9
    assert evaluation(held_out([True] * 40 + [False])).uri.startswith("data:image")


def test_none_in_the_mesh_is_told_in_a_sentence(held_out):
    hidden = held_out([False] * 2)
    assert evaluation_table(hidden).caption.startswith("None of the 2 landmarks that were held out lies in the mesh")
    assert evaluation(hidden) is None


def test_without_landmarks_there_is_no_table(seen):
    assert evaluation_table(seen) is None
    assert evaluation(seen) is None
