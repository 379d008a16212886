"""Effective number of independent points, on fields whose correlation is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.model.independence import independent_points
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
