"""Scores of fields whose error, coverage and folds are known."""

import numpy as np
import pytest
from scipy.stats import norm

from bayesreg.io.fields import save_displacement
from studies.external.score import Truth, compare, determinant, read_field

SHAPE = (12, 10, 8)
AFFINE = np.diag([-2.0, 1.5, 1.0, 1.0])
AFFINE[:3, 3] = [11.0, -7.0, -4.0]


@pytest.fixture
def truth():
    rng = np.random.default_rng(0)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in SHAPE], indexing="ij"), axis=-1)
    x = index @ AFFINE[:3, :3].T + AFFINE[:3, 3]
    # Linear, so that the points, between voxels, are found exactly.
    slope, shift = rng.uniform(-0.1, 0.1, (3, 3)), np.array([4.0, -1.0, 2.0])
    u = x @ slope.T + shift
    labels = np.ones(SHAPE, int)
    labels[:, :, 3:5], labels[:, :, 5:] = 2, 3
    points = rng.uniform(3, 5, (20, 3)) @ AFFINE[:3, :3].T + AFFINE[:3, 3]
    return Truth(u, np.ones(SHAPE, bool), None, labels, points, points + points @ slope.T + shift, AFFINE)


def test_the_truth_has_no_error(truth):
    scores = compare(truth, truth.u)
    nothing = pytest.approx([0, 0, 0], abs=1e-3)
    assert scores["error"] == scores["csf"] == scores["gm"] == scores["wm"] == nothing
    assert scores["tre"] == pytest.approx([0, 0], abs=1e-3)
    assert scores["given_share"] == 1
    assert scores["folded_share"] == 0
    assert scores["cavity_walls"] is None
    assert scores["unregistered_mean"] == pytest.approx(np.linalg.norm(truth.u, axis=-1).mean(), abs=1e-3)
    assert "coverage_50_90_95" not in scores


def test_error_by_tissue_where_the_field_is_given(truth):
    off = np.zeros((*SHAPE, 3))
    off[truth.labels == 2] = [3.0, 0.0, 4.0]
    off[0] = 100.0
    defined = np.ones(SHAPE, bool)
    defined[0] = False
    scores = compare(truth, truth.u + off, defined=defined)
    assert scores["gm"] == [5, 5, 5]
    assert scores["csf"] == scores["wm"] == [0, 0, 0]
    assert scores["error"] == [1.25, 5, 5]
    assert scores["given_share"] == pytest.approx(11 / 12, abs=1e-4)


def test_coverage_and_sharpness(truth):
    rng = np.random.default_rng(1)
    sd = rng.uniform(0.2, 2.0, (*SHAPE, 3))
    # Every quantile once, in a random order.
    levels = (np.arange(sd.size) + 0.5) / sd.size
    z = rng.permutation(norm.ppf(levels)).reshape(sd.shape)
    honest, narrow = (compare(truth, truth.u + z * sd, width * sd) for width in (1.0, 0.5))
    assert honest["coverage_50_90_95"] == pytest.approx([0.5, 0.9, 0.95], abs=2e-3)
    assert honest["sd_over_rms_error"] == pytest.approx(1, abs=0.05)
    half = [2 * norm.cdf(norm.ppf(0.5 + level / 2) / 2) - 1 for level in (0.5, 0.9, 0.95)]
    assert narrow["coverage_50_90_95"] == pytest.approx(half, abs=2e-3)
    assert narrow["sd_over_rms_error"] == pytest.approx(honest["sd_over_rms_error"] / 2, abs=1e-3)


def test_folds_are_found_on_a_flipped_grid(truth):
    x = np.arange(SHAPE[0]) * AFFINE[0, 0] + AFFINE[0, 3]
    folding = np.zeros((*SHAPE, 3))
    # x goes to -x where it is negative.
    folding[..., 0] = np.where(x < 0, -2 * x, 0.0)[:, None, None]
    J = determinant(folding, AFFINE)
    assert J[x < -2] == pytest.approx(-1)
    assert J[x > 2] == pytest.approx(1)
    # x is -11, -9, … 11, and a difference across zero is half of both: 5 of the 10 inside.
    assert compare(truth, folding)["folded_share"] == 0.5


def test_fields_in_files_are_lps(truth, tmp_path):
    save_displacement(tmp_path / "u.nii.gz", truth.u, AFFINE)
    assert read_field(tmp_path / "u.nii.gz") == pytest.approx(truth.u, abs=1e-5)
