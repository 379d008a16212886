"""The number of independent points that are equivalent to a correlated residual."""

from __future__ import annotations

from itertools import product

import numpy as np
import scipy.fft
import scipy.linalg
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.model.term import PointCurvature
from bayesreg.types import InputError

# The greatest number of patches whose forces are compared with the model, and the least number of points of one.
MOST_PATCHES, LEAST_POINTS = 500, 20


def independent_points(residual: Image, mask: Image) -> float:
    """Compute the effective number of independent points of a residual in a mask: its volume over ∫ρ(h) dh.

    ρ is the autocorrelation at lag h, over all pairs of voxels inside the mask. The integral runs over the ball up to
    the first lag at which the mean of ρ over directions is not positive: beyond it, ρ contains only noise.

    Parameters
    ----------
    residual : Image
        f(x) − m(x + u(x)) on a grid.
    mask : Image
        Nonzero = inside, on the same grid: the voxels that the likelihood compares.

    Returns
    -------
    float
        Between one and the number of voxels inside; for `ModelConfig.independent_points`, which may be no more
        than the number of quadrature points.

    Raises
    ------
    InputError
        If the grids differ, or the residual inside the mask is constant.
    """
    if residual.shape != mask.shape or not np.allclose(residual.affine, mask.affine):
        raise InputError(f"residual and mask must share one grid; got {residual.shape} and {mask.shape}")
    inside = np.asarray(mask.voxels) != 0
    values = np.asarray(residual.voxels, float)[inside]
    if len(values) < 2 or np.ptp(values) == 0:
        raise InputError("the residual is constant inside the mask, or the mask is empty: no autocorrelation")
    centred = np.zeros(inside.shape)
    centred[inside] = values - values.mean()
    box = ndimage.find_objects(inside.astype(int))[0]
    correlation, pairs = _autocorrelation(centred[box], inside[box])
    lags = _lag_lengths(correlation.shape, residual)
    near = (pairs > 0) & (lags < _first_gap(correlation, pairs, lags, residual.voxel_sizes.max()))
    return float(np.clip(inside.sum() / correlation[near].sum(), 1, inside.sum()))


def independent_scores(
    scores: Float[np.ndarray, "points axes"], voxels: Int[np.ndarray, "points 3"], grid: Image
) -> float:
    """Compute the effective number of independent points of a sum over voxels, from the variance of the sum.

    An example of a score is w (f − m) ∇m at the voxels: the sum is the force on a displacement that is smooth on the
    scale on which the scores are correlated. Noise that is smoother than the images reduces the number a little, and a
    misfit of the model reduces it much. The sum of n scores s_i with the autocovariance c(h), summed over the axes, has
    the variance Σ_h n(h) c(h), where n(h) is the number of pairs at lag h. The effective number is n² c(0) over this
    variance. The sum over h runs as in `independent_points`. (With this adjustment, the likelihood has the curvature
    that the variance of its gradient requires: Ribatet, Cooley and Davison 2012, "Bayesian inference from composite
    likelihoods, with an application to spatial extremes".)

    Parameters
    ----------
    scores : (n, a) array
    voxels : (n, 3) int array
        Their places on the grid.
    grid : Image
        Only its shape and affine are used.

    Returns
    -------
    float
        Between one and n.

    Raises
    ------
    InputError
        If all scores are zero.
    """
    low, high = voxels.min(axis=0), voxels.max(axis=0) + 1
    inside = np.zeros(high - low, bool)
    places = tuple((voxels - low).T)
    inside[places] = True
    fields = np.zeros((scores.shape[1], *inside.shape))
    fields[:, *places] = scores.T
    covariance, pairs = _products(fields, inside)
    if not covariance[0, 0, 0] > 0:
        raise InputError("the residual is zero at every point: nothing tells how it is correlated")
    correlation = covariance / np.maximum(pairs, 1) / (covariance[0, 0, 0] / pairs[0, 0, 0])
    lags = _lag_lengths(pairs.shape, grid)
    near = (pairs > 0) & (lags < _first_gap(correlation, pairs, lags, grid.voxel_sizes.max()))
    share = (pairs * correlation)[near].sum() / len(voxels)
    return float(np.clip(len(voxels) / share, 1, len(voxels)))


def independent_blocks(
    forces: Float[np.ndarray, "points 3"], points: PointCurvature, blocks: Int[np.ndarray, "points"]
) -> float:
    """Compute the ratio of the squared forces on blocks that the model expects to those that are there.

    In the model, the force on a block, which is the gradient of the log likelihood in a shift of the block, has the
    covariance A_b, its expected curvature. The result is Σ_b tr A_b / Σ_b |g_b|². The sum over a block keeps noise that
    is correlated, and loses the gradient of noise in m but for the border of the block. (For the ratio of curvature to
    the variance of scores see Ribatet, Cooley and Davison 2012.)

    Parameters
    ----------
    forces : (q, 3) array
        The gradient of the log likelihood in the displacement of each point, 1/mm.
    points : PointCurvature
        The Gauss–Newton curvature of the same likelihood.
    blocks : (q,) int array
        The block of each point; every group of the shared curvature lies within one block.

    Raises
    ------
    InputError
        If all forces are zero.
    """
    force = np.stack([np.bincount(blocks, weights=component) for component in forces.T])
    if not force.any():
        raise InputError("the residual is zero at every point: nothing tells how it is correlated")
    trace = float(np.asarray(points.matrices).trace(axis1=1, axis2=2).sum())
    if points.shared is not None:
        groups = np.asarray(points.shared.groups)
        for sign, vectors in zip(np.asarray(points.shared.signs), np.asarray(points.shared.vectors), strict=True):
            trace += float(sign) * sum((np.bincount(groups, weights=vector) ** 2).sum() for vector in vectors.T)
    return trace / float((force**2).sum())


def excess_of_patches(
    forces: Float[np.ndarray, "points 3"], points: PointCurvature, curvature: Float[np.ndarray, "unknowns unknowns"]
) -> float:
    """Compute how many times as large as in the model the squared forces on patches are, at a mode.

    The patch of a node is the tetrahedra around it. In the model, the force g on a patch, which is the gradient of the
    log likelihood in a shift of the patch, has the covariance A = Σ_q A_q at the true displacement. At the mode the
    displacements have followed the forces, and the covariance is A − Jᵀ H⁻¹ J, where J is the curvature between the
    nodes and the patch, and H the whole curvature. The result is the mean of gᵀ (A − Jᵀ H⁻¹ J)⁻¹ g / 3 over patches. It
    is one if nothing but noise is left. A misfit as wide as a tetrahedron, such as that of a displacement which the
    mesh cannot resolve, makes it larger, and hardly shows in the correlation of neighbouring residuals, since the
    displacements have absorbed most of it.

    Parameters
    ----------
    forces : (q, 3) array
        The gradient of the log likelihood in the displacement of each point, 1/mm.
    points : PointCurvature
        A_q, the Gauss–Newton curvature of the same likelihood.
    curvature : (3n, 3n) array
        H, 1/mm², with row 3 · node + axis.
    """
    nodes, count = np.asarray(points.nodes), len(curvature) // 3
    matrices = np.asarray(points.matrices)
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_PATCHES)).round().astype(int))
    places, shape = (np.repeat(np.arange(len(nodes)), 4), nodes.ravel()), (len(nodes), count)
    interpolation = scipy.sparse.csr_array((np.asarray(points.weights).ravel(), places), shape)
    members = scipy.sparse.csr_array((np.ones(nodes.size), places), shape)[:, chosen]
    chosen = chosen[members.sum(axis=0) >= LEAST_POINTS]
    members = members[:, members.sum(axis=0) >= LEAST_POINTS]
    force = members.T @ forces
    alone = (members.T @ matrices.reshape(-1, 9)).reshape(-1, 3, 3)
    coupling = np.empty((count, 3, len(chosen), 3))
    for i, j in product(range(3), repeat=2):
        coupling[:, i, :, j] = (interpolation.T @ (scipy.sparse.diags_array(matrices[:, i, j]) @ members)).toarray()
    followed = scipy.linalg.solve(curvature, coupling.reshape(3 * count, -1), assume_a="pos")
    by_patch = (array.reshape(3 * count, -1, 3) for array in (coupling, followed))
    covariance = alone - np.einsum("umi,umj->mij", *by_patch)
    return float((force * np.linalg.solve(covariance, force[:, :, None])[:, :, 0]).sum(axis=1).mean() / 3)


def _autocorrelation(
    centred: Float[np.ndarray, "X Y Z"], inside: Bool[np.ndarray, "X Y Z"]
) -> tuple[Float[np.ndarray, "U V W"], Float[np.ndarray, "U V W"]]:
    """Compute ρ(h) and the number of pairs at every lag; zero lag comes first, negative lags last."""
    products, pairs = _products(centred[None], inside)
    covariance = products / np.maximum(pairs, 1)
    return covariance / covariance[0, 0, 0], pairs


def _products(
    fields: Float[np.ndarray, "fields X Y Z"], inside: Bool[np.ndarray, "X Y Z"]
) -> tuple[Float[np.ndarray, "U V W"], Float[np.ndarray, "U V W"]]:
    """Sum the products of all pairs at every lag over some fields, and count these pairs; see `_autocorrelation`."""
    shape = [scipy.fft.next_fast_len(2 * n, real=True) for n in inside.shape]

    def products(fields: np.ndarray) -> np.ndarray:
        power = sum(np.abs(scipy.fft.rfftn(field, shape, workers=-1)) ** 2 for field in fields)
        return scipy.fft.irfftn(power, shape, workers=-1)

    return products(fields), np.rint(products(inside[None].astype(float)))


def _lag_lengths(shape: tuple[int, ...], grid: Image) -> Float[np.ndarray, "U V W"]:
    """Compute |h| of every lag, mm."""
    steps = np.meshgrid(*(np.fft.fftfreq(n, 1 / n) for n in shape), indexing="ij", sparse=True)
    lags = np.asarray(grid.affine)[:3, :3] @ np.array(steps, dtype=object)
    return np.sqrt(sum(lag**2 for lag in lags))


def _first_gap(correlation: np.ndarray, pairs: np.ndarray, lags: np.ndarray, width: float) -> float:
    """Find the first lag at which the mean of ρ over directions is not positive, in shells of a given width, mm."""
    shell = np.rint(lags / width).astype(int).ravel()
    total, weight = (np.bincount(shell, weights=w.ravel()) for w in (pairs * correlation, pairs))
    gaps = np.flatnonzero((total <= 0) & (weight > 0))
    return (gaps[0] - 0.5) * width if len(gaps) else np.inf
