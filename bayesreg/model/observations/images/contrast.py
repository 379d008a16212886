"""A map from the intensities of f, the fixed image, to the intensities of m, the moving image, for unlike contrasts.

The map is m(x + u) ≈ Σ_k c_k b_k(x) with coefficients c_k and these functions b_k:

- cubic B-splines of f(x), which map every intensity of f to an intensity of m;
- |∇f(x)|, which gives borders a brightness of their own, as in ultrasound;
- 1 and f(x) within each tissue, if the labels are known, so that tissues of equal brightness in f may differ in m.

`ImageOptions.intensity_map` adds a shading. (Roche et al. 1998, "The correlation ratio as a new similarity measure for
multimodal image registration"; with |∇f|, Wein et al. 2008, "Automatic CT-ultrasound registration for diagnostic
imaging and image-guided intervention".)

The coefficients that fit best at rest (u = 0) convert f to the contrast of m. The pair is then compared like a pair of
one contrast. The map has an error because the tissues of both images do not coincide at rest. Therefore the
coefficients are inferred with all other unknowns, with Normal priors around their values at rest, so that every
interval includes the uncertainty of the map.

Smoothing before a map of intensities and smoothing after it give different images. Therefore the b_k are computed as
images, and are smoothed like m.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline

from bayesreg.image import Image

# The number of splines of f. It is enough for four tissues and their partial volumes.
SPLINES = 8
# The splines lie between these quantiles of f. Each spline is tabulated at LEVELS intensities.
ENDS, LEVELS = (0.005, 0.995), 1024
# The ridge of the fit for each function, as a share of the function's sum of squares over the points.
RIDGE = 1e-4
# For the fit at rest all images are smoothed with this sd, in voxels of the coarser image. This reduces the error that
# arises because the tissues do not coincide.
BLUR = 1.5


def map_contrast(
    fixed: Image, moving: Image, positions: Float[np.ndarray, "points 3"], tissue: Image | None = None
) -> Image:
    """Convert the fixed image to the contrast of the moving image, by the map that fits best at rest.

    Parameters
    ----------
    fixed, moving : Image
    positions : (q, 3) array
        The points at which the map is fitted, world, mm.
    tissue : Image, optional
        Labels of the tissues on the grid of the fixed image, 0 outside all tissues.

    Returns
    -------
    Image
        The converted image, on the grid of the fixed image.
    """
    sd = BLUR * max(image.voxel_volume for image in (fixed, moving)) ** (1 / 3)
    target = np.asarray(moving.smoothed(sd).interpolate(positions))
    coefficients = _fit(contrast_functions(fixed, positions, sd, tissue), target)
    voxels = np.zeros(fixed.shape)
    for coefficient, image in zip(coefficients, _function_images(fixed, positions, tissue), strict=True):
        voxels += coefficient * np.asarray(image.voxels)
    return fixed.with_voxels(voxels)


def contrast_functions(
    fixed: Image, positions: Float[np.ndarray, "points 3"], sd: float = 0.0, tissue: Image | None = None
) -> Float[np.ndarray, "points functions"]:
    """Evaluate the functions b_k, smoothed with the standard deviation sd, mm, at some points (world, mm)."""
    images = _function_images(fixed, positions, tissue)
    smooth = (image.smoothed(sd) if sd else image for image in images)
    return np.stack([np.asarray(image.interpolate(positions)) for image in smooth], axis=1)


def explained_shares(
    predictor: Float[np.ndarray, "points"], response: Float[np.ndarray, "points"]
) -> tuple[float, float]:
    """Compute how well the intensities `predictor` predict the intensities `response` at the same points.

    Returns
    -------
    tuple of float
        Two shares of the variance of `response`: the share that a straight line in `predictor` explains, with a minus
        sign if the line falls, and the share that splines of `predictor` explain.
    """
    correlation = float(np.corrcoef(predictor, response)[0, 1])
    left = map_residual(predictor, response)
    return correlation * abs(correlation), float(max(1 - left.var() / response.var(), 0.0))


def map_residual(predictor: Float[np.ndarray, "points"], response: Float[np.ndarray, "points"]) -> np.ndarray:
    """Return what the best map by splines of the intensities `predictor` leaves of the intensities `response`."""
    functions = np.stack([spline(predictor) for spline in _splines(predictor)], axis=1)
    return response - functions @ _fit(functions, response)


def _function_images(fixed: Image, positions: Float[np.ndarray, "points 3"], tissue: Image | None) -> Iterator[Image]:
    """Yield the functions b_k as images: splines of f, then |∇f|, then 1 and f within each tissue.

    The splines lie between two quantiles of f at these points (world, mm). |∇f| is divided by the difference of these
    quantiles, so that its unit is 1/mm.
    """
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
    """Make cubic B-splines between two quantiles of some values; beyond the quantiles the splines are constant."""
    low, high = np.quantile(values, ENDS)
    knots = np.concatenate([np.full(3, low), np.linspace(low, high, SPLINES - 2), np.full(3, high)])
    levels = np.linspace(low, high, LEVELS)
    return [partial(np.interp, xp=levels, fp=column) for column in BSpline.design_matrix(levels, knots, 3).toarray().T]


def _fit(functions: Float[np.ndarray, "points k"], values: Float[np.ndarray, "points"]) -> Float[np.ndarray, "k"]:
    """Fit values by functions with least squares; a small ridge draws each coefficient to the mean of the values."""
    products = functions.T @ functions
    middle = np.full(functions.shape[1], values.mean())
    ridge = RIDGE * np.diag(np.maximum(products.diagonal(), 1e-12 * products.trace()))
    return middle + np.linalg.solve(products + ridge, functions.T @ (values - functions @ middle))
