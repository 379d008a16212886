"""Geweke's test of the paper's kernel, small; `make calibrate` has the others, and longer."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from studies.calibration import geweke
from studies.calibration.simulator import VARIANTS, Simulator, calibrated

SIZE = {"chains": 120, "steps": 40}


@cache
def simulator():
    return Simulator(VARIANTS["no skull"])


@pytest.mark.slow
def test_the_papers_kernel_leaves_the_joint_distribution_alone():
    comparison = geweke.compare(simulator(), "rwmh", **SIZE)
    assert comparison.passes
    assert 0.6 < np.mean(comparison.z**2) < 1.6
    assert 0.1 < comparison.acceptance < 0.9
    assert comparison.moved > 0.5


@pytest.mark.slow
def test_a_density_without_its_normaliser_is_found_out():
    """The paper's: λ and μ drift towards zero."""
    wrong = calibrated(VARIANTS["no skull"], normalised=False)
    comparison = geweke.compare(simulator(), "rwmh", wrong, **SIZE)
    assert not comparison.passes
