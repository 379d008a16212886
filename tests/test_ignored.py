"""Voxels that say nothing: the filling of a grid around what was seen."""

from __future__ import annotations

import numpy as np

from bayesreg.ignored import find_filling
from bayesreg.image import Image

RNG = np.random.default_rng(0)
NOISE = RNG.normal(100, 20, size=(30, 34, 28))
X, Y, Z = np.meshgrid(*(np.arange(n) for n in NOISE.shape), indexing="ij")


def filling(voxels):
    return find_filling(Image(voxels, np.eye(4)))


def test_the_outside_of_a_wedge_is_found_and_zeros_within_are_not():
    wedge = np.abs(X - 15) < 2 + Z / 2
    voxels = np.where(wedge, NOISE, 0)
    voxels[14:17, 15:18, 20:23] = 0
    np.testing.assert_array_equal(filling(voxels), ~wedge)


def test_slabs_beyond_the_field_are_found_whatever_their_value():
    outside = (Z > 22) | (Z < 3)
    np.testing.assert_array_equal(filling(np.where(outside, -1024, NOISE)), outside)


def test_measured_images_have_no_filling():
    assert not filling(NOISE).any()
    assert not filling(np.rint(NOISE)).any()


def test_equal_noise_of_rounded_air_is_no_filling():
    """Air that is 0, 1 or 2 by chance, around a body."""
    body = (X - 15) ** 2 + (Y - 17) ** 2 + (Z - 14) ** 2 < 90
    assert not filling(np.where(body, NOISE, RNG.integers(0, 3, NOISE.shape))).any()
