"""The judgement of external pairs, on numbers that are known."""

from __future__ import annotations

import numpy as np
import pytest

from studies.calibration.external import PAIRS, PairResult, summarise


def pair(share, ratio=(1.2, 1.9)):
    shares = np.array([share - 0.4, share, share + 0.04])
    return PairResult(shares - 0.1, shares, 1.0, np.array([0.1, 0.3, 2.0]), np.array(ratio), True)


def test_the_mean_over_pairs_is_judged_and_its_error_told():
    summary = summarise({"sag-21-0": pair(0.95), "gravity-21-0": pair(0.85), "gravity-22-0": pair(0.9, (1.2, 1.5))})
    assert summary["as_it_should"]
    assert summary["coverage"]["after"]["90%"] == pytest.approx([0.9, 0.05 / np.sqrt(3)])
    assert summary["coverage"]["before"]["50%"][0] == pytest.approx(0.4)
    assert summary["ratio of white over grey held"] == "1 of 2"
    assert summary["converged"] == 3
    assert not summarise({"a": pair(0.7), "b": pair(0.75)})["as_it_should"]


def test_there_are_twelve_pairs():
    assert len(set(PAIRS)) == 12
