"""Effective number of independent points, on fields whose correlation is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.model.independence import independent_points, independent_scores
from bayesreg.types import InputError
from tests.phantoms import rotated_affine

SIZES = np.array([1.0, 1.5, 2.0])
SHAPE = (60, 44, 36)


def ball():
    """A mask that is no box."""
    axes = (np.arange(n) - (n - 1) / 2 for n in SHAPE)
    return sum((x / (n / 2)) ** 2 for x, n in zip(np.meshgrid(*axes, indexing="ij"), SHAPE, strict=True)) < 1


def affine():
    corners = np.array([[0.0, 0.0, 0.0], (np.array(SHAPE) - 1) * SIZES])
    rotation = rotated_affine(corners, SHAPE)[:3, :3]
    found = np.eye(4)
    found[:3, :3] = rotation / np.linalg.norm(rotation, axis=0) * SIZES
    return found


def field(width, seed=0):
    """White noise smoothed by a Gaussian of sd `width` mm: ρ(h) = exp(−h² / 4 width²)."""
    noise = np.random.default_rng(seed).normal(size=SHAPE)
    return 0.3 + 2 * ndimage.gaussian_filter(noise, width / SIZES, mode="wrap", truncate=6)


@pytest.mark.parametrize("width", [1.6, 2.5])
def test_smooth_noise_has_the_volume_of_its_correlation(width):
    """∫ρ = (4π width²)^(3/2)."""
    mask = ball()
    volume = mask.sum() * SIZES.prod()
    expected = volume / (4 * np.pi * width**2) ** 1.5
    grid = affine()
    found = [
        independent_points(Image(field(width, seed), grid), Image(mask.astype(np.uint8), grid)) for seed in range(6)
    ]
    assert np.mean(found) == pytest.approx(expected, rel=0.1)
    assert 0.6 * expected < min(found) < max(found) < 1.5 * expected


def test_white_noise_is_worth_all_its_points():
    grid, mask = affine(), ball()
    noise = np.random.default_rng(1).normal(size=SHAPE)
    found = independent_points(Image(noise, grid), Image(mask.astype(np.uint8), grid))
    assert 0.9 * mask.sum() < found <= mask.sum()


def test_outside_the_mask_nothing_matters():
    grid, mask = affine(), ball()
    values = field(2.0)
    changed = np.where(mask, values, 1e3)
    first, second = (independent_points(Image(v, grid), Image(mask.astype(np.uint8), grid)) for v in (values, changed))
    assert first == pytest.approx(second, rel=1e-12)


def test_what_has_no_autocorrelation():
    grid = affine()
    image, mask = Image(np.ones(SHAPE), grid), Image(ball().astype(np.uint8), grid)
    with pytest.raises(ValueError, match="constant inside the mask"):
        independent_points(image, mask)
    with pytest.raises(ValueError, match="one grid"):
        independent_points(Image(np.ones((3, 3, 3)), grid), mask)


def test_scores_of_white_noise_are_worth_all_their_points():
    grid, voxels = Image(np.zeros(SHAPE), affine()), np.argwhere(ball())
    scores = np.random.default_rng(1).normal(size=(len(voxels), 3))
    assert 0.9 * len(voxels) < independent_scores(scores, voxels, grid) <= len(voxels)


@pytest.mark.parametrize("density", [1.0, 0.2])
def test_scores_of_some_voxels_count_by_the_variance_of_their_sum(density):
    """n independent ones of the same variance would have a sum as variable as this one, over many realisations."""
    rng = np.random.default_rng(0)
    chosen = np.argwhere(ball() & (rng.uniform(size=SHAPE) < density))
    at, found, sums, variance = tuple(chosen.T), [], [], []
    for seed in range(60):
        values = field(2.0, seed)[at] - 0.3
        sums.append(values.sum())
        variance.append((values**2).mean())
        if seed < 6:
            found.append(independent_scores(values[:, None], chosen, Image(np.zeros(SHAPE), affine())))
    expected = len(chosen) ** 2 * np.mean(variance) / np.mean(np.square(sums))
    assert np.mean(found) == pytest.approx(expected, rel=0.4)
    assert np.mean(found) < 0.5 * len(chosen)


def test_a_residual_of_nothing_is_told():
    with pytest.raises(InputError, match="zero at every point"):
        independent_scores(np.zeros((3, 1)), np.arange(9).reshape(3, 3), Image(np.zeros(SHAPE), affine()))
