"""A map from the intensities of f to those of m, for pairs of unlike contrast.

m(x + u) ≈ Σ_k c_k b_k(x). The b_k are cubic B-splines of f(x), so that every intensity of f has one in m; 1 and f(x)
within each tissue, if the labels are known, so that tissues of equal brightness in f may differ in m; and |∇f(x)|, so
that borders have a brightness, as in ultrasound. `ModelConfig.intensity_map` adds a shading. (Roche et al. 1998, "The
correlation ratio as a new similarity measure for multimodal image registration"; with |∇f|, Wein et al. 2008,
"Automatic CT-ultrasound registration for diagnostic imaging and image-guided intervention".) The coefficients with the
best fit at rest convert f to the contrast of m, and the pair is then compared as a pair of one contrast. The map has an
error because the tissues do not coincide at rest. Therefore the coefficients are inferred with all other unknowns, with
Normal priors around their values at rest, so that every interval includes the uncertainty of the map.

Smoothing and a map of intensities do not commute. The b_k are therefore images, and are smoothed as m is.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline

from bayesreg.image import Image

# Number of splines of f: enough for four tissues and their partial volumes.
SPLINES = 8
# The quantiles of f between which the splines lie, and the number of points of their table.
ENDS, LEVELS = (0.005, 0.995), 1024
# Ridge of the fit, as a share of the mean square of a function.
RIDGE = 1e-4
# Sd of the smoothing of all images for the fit at rest, in voxels of the coarser image. It reduces the error from
# tissues that do not coincide.
BLUR = 1.5


def map_contrast(
    fixed: Image, moving: Image, positions: Float[np.ndarray, "points 3"], tissue: Image | None = None
) -> Image:
    """Convert the fixed image to the contrast of the moving one, by the best map at rest.

    Parameters
    ----------
    fixed, moving : Image
    positions : (q, 3) array
        Where to compare them, mm.
    tissue : Image, optional
        Labels on the grid of the fixed image, 0 outside.

    Returns
    -------
    Image
        On the grid of the fixed image.
    """
    sd = BLUR * max(image.voxel_volume for image in (fixed, moving)) ** (1 / 3)
    target = np.asarray(moving.smoothed(sd).interpolate(positions))
    coefficients = _fit(contrast_functions(fixed, positions, sd, tissue), target)
    found = np.zeros(fixed.shape)
    for coefficient, image in zip(coefficients, _function_images(fixed, positions, tissue), strict=True):
        found += coefficient * np.asarray(image.voxels)
    return fixed.with_voxels(found)


def contrast_functions(
    fixed: Image, positions: Float[np.ndarray, "points 3"], sd: float = 0.0, tissue: Image | None = None
) -> Float[np.ndarray, "points functions"]:
    """Evaluate b_k at some points, smoothed by sd, both in mm."""
    images = _function_images(fixed, positions, tissue)
    smooth = (image.smoothed(sd) if sd else image for image in images)
    return np.stack([np.asarray(image.interpolate(positions)) for image in smooth], axis=1)


def explained_shares(one: Float[np.ndarray, "points"], other: Float[np.ndarray, "points"]) -> tuple[float, float]:
    """Compute the shares of the variance of the other intensities that a line and splines of the first explain.

    The share of the line is negative if the line falls.
    """
    correlation = float(np.corrcoef(one, other)[0, 1])
    functions = np.stack([spline(one) for spline in _splines(one)], axis=1)
    left = other - functions @ _fit(functions, other)
    return correlation * abs(correlation), float(max(1 - left.var() / other.var(), 0.0))


def _function_images(fixed: Image, positions: Float[np.ndarray, "points 3"], tissue: Image | None) -> Iterator[Image]:
    """Return the splines of f between its quantiles at these points, |∇f| over their range, and 1 and f by tissue."""
    voxels, values = np.asarray(fixed.voxels, float), np.asarray(fixed.interpolate(positions))
    for spline in _splines(values):
        yield fixed.with_voxels(spline(voxels))
    along = np.stack(np.gradient(voxels), axis=-1) @ fixed.to_voxel[:3, :3]
    yield fixed.with_voxels(np.linalg.norm(along, axis=-1) / np.ptp(np.quantile(values, ENDS)))
    if tissue is not None:
        labels = np.asarray(tissue.voxels)
        for label in np.unique(labels[labels > 0]):
            yield fixed.with_voxels((labels == label).astype(float))
            yield fixed.with_voxels(voxels * (labels == label))


def _splines(values: Float[np.ndarray, "points"]) -> list[partial[np.ndarray]]:
    """Make cubic B-splines between two quantiles of some values, constant beyond them."""
    low, high = np.quantile(values, ENDS)
    knots = np.concatenate([np.full(3, low), np.linspace(low, high, SPLINES - 2), np.full(3, high)])
    levels = np.linspace(low, high, LEVELS)
    return [partial(np.interp, xp=levels, fp=column) for column in BSpline.design_matrix(levels, knots, 3).toarray().T]


def _fit(functions: Float[np.ndarray, "points k"], values: Float[np.ndarray, "points"]) -> Float[np.ndarray, "k"]:
    """Compute coefficients by least squares, with a small ridge around the mean."""
    products = functions.T @ functions
    middle = np.full(functions.shape[1], values.mean())
    ridge = RIDGE * np.diag(np.maximum(products.diagonal(), 1e-12 * products.trace()))
    return middle + np.linalg.solve(products + ridge, functions.T @ (values - functions @ middle))
