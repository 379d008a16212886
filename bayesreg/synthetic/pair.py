"""Make synthetic pairs with a known truth, as in section 4.1 of the paper."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.synthetic.deformation import Deformation, Direction, push_patch
from bayesreg.synthetic.inversion import deformed_image, residuals
from bayesreg.tissues import is_fluid
from bayesreg.types import InputError


class SyntheticPair(NamedTuple):
    """Two images, and the known deformation that made the second from the first.

    Attributes
    ----------
    fixed, moving : Image
        f and m on one grid, noise included; m(x + u(x)) = f(x) except for noise and interpolation.
    mesh : TetMesh
        The mesh on which the pair was made. If the registration uses another mesh, the truth there is
        `transfer(pair.u, pair.mesh, other.points)`.
    u : (n, 3) array
        True displacement of every node of `mesh`, mm.
    lam, mu : (T,) array
        True Lamé parameters.
    deformation : Deformation
    residual_sd : float
        Standard deviation of f(x) − m(x + u(x)) at the four-point quadrature points, with linear interpolation. It
        includes noise and interpolation.
    interpolation_sd : float
        `residual_sd` without the noise.
    smoothing_mm, noise_sd : float
        The arguments of `make_pair`.
    """

    fixed: Image
    moving: Image
    mesh: TetMesh
    u: Float[np.ndarray, "nodes 3"]
    lam: Float[np.ndarray, "tissues"]
    mu: Float[np.ndarray, "tissues"]
    deformation: Deformation
    residual_sd: float
    interpolation_sd: float
    smoothing_mm: float
    noise_sd: float


def make_pair(
    fixed: Image,
    tissue: Image,
    skull: Image,
    mesh: TetMesh,
    *,
    lam: Float[np.ndarray, "tissues"],
    mu: Float[np.ndarray, "tissues"],
    displacement: float = 15.0,
    patch_nodes: int = 20,
    direction: Direction | None = None,
    margin: float = 0.1,
    smoothing_mm: float = 0.75,
    noise_sd: float = 0.003,
    seed: int = 0,
) -> SyntheticPair:
    """Make a pair of images with a known deformation and stiffness.

    The *paper pair* has the defaults, and the registration uses the same mesh, as in the paper (an inverse crime). The
    *calibrated pair* has `noise_sd` 0.01 and a finer mesh than the registration; the same number of patch nodes is then
    a smaller patch.

    Parameters
    ----------
    fixed : Image
        The fixed image with intensities in about [0, 1]; the noise is not scaled to the intensities.
    tissue : Image
        0 = outside, then 1 + index into `mesh.names`; on the grid of `fixed`.
    skull : Image
        Nonzero = forbidden; on the same grid.
    mesh : TetMesh
        The mesh on which the pair is made. Space that its tissues leave gets the median intensity of the fluid
        (`bayesreg.tissues`), or of the voxels outside all tissues if no tissue is a fluid.
    lam, mu : (T,) array
        Lamé parameters by tissue.
    displacement, patch_nodes, direction, margin
        See `push_patch`.
    smoothing_mm : float, default 0.75
        Standard deviation of the Gaussian that smooths f first; 0 for no smoothing. Linear interpolation of Colin27
        gives a residual sd at the truth of 0.010 without smoothing, 0.005 with the default, and 0.003 with 1 mm.
    noise_sd : float, default 0.003
        Standard deviation of the independent Normal noise on each image.
    seed : int, default 0
        The seed of the noise.

    Raises
    ------
    InputError
        If the images are on different grids or do not cover the mesh, or no voxel has an intensity for free space; and
        as `push_patch`.
    """
    _require_one_grid(fixed, tissue, skull, mesh)
    if smoothing_mm < 0 or noise_sd < 0:
        raise InputError(f"smoothing_mm and noise_sd must not be negative, got {smoothing_mm} and {noise_sd}")
    fixed = fixed.smoothed(smoothing_mm)
    filling = _filling_intensity(fixed, tissue, mesh)
    truth = push_patch(
        mesh,
        skull,
        lam=lam,
        mu=mu,
        displacement=displacement,
        patch_nodes=patch_nodes,
        direction=direction,
        margin=margin,
    )
    moving = deformed_image(fixed, tissue, skull, mesh, truth.u, filling)
    noisy = [_noisy(image, noise_sd, stream) for image, stream in zip((fixed, moving), _streams(seed), strict=True)]
    return SyntheticPair(
        fixed=noisy[0],
        moving=noisy[1],
        mesh=mesh,
        u=truth.u,
        lam=np.asarray(lam, float),
        mu=np.asarray(mu, float),
        deformation=truth,
        residual_sd=float(residuals(noisy[0], noisy[1], mesh, truth.u).std()),
        interpolation_sd=float(residuals(fixed, moving, mesh, truth.u).std()),
        smoothing_mm=smoothing_mm,
        noise_sd=noise_sd,
    )


def _filling_intensity(fixed: Image, tissue: Image, mesh: TetMesh) -> float:
    """Compute the median intensity of the fluid, or of the voxels without tissue if there is no fluid."""
    fluids = [index for index, name in enumerate(mesh.names, start=1) if is_fluid(name)]
    values = np.asarray(fixed.voxels)[np.isin(np.asarray(tissue.voxels), fluids or [0])]
    if values.size == 0:
        voxel_kind = " or ".join(mesh.names[index - 1] for index in fluids) or "place without tissue"
        raise InputError(
            f"free space cannot be filled: the tissue image has no {voxel_kind} voxel to take an intensity from"
        )
    return float(np.median(values))


def _streams(seed: int) -> list[np.random.Generator]:
    return np.random.default_rng(seed).spawn(2)


def _noisy(image: Image, sd: float, stream: np.random.Generator) -> Image:
    return image.with_voxels(image.voxels + sd * stream.normal(size=image.shape))


def _require_one_grid(fixed: Image, tissue: Image, skull: Image, mesh: TetMesh) -> None:
    for name, image in (("tissue", tissue), ("skull", skull)):
        if image.shape != fixed.shape or not np.allclose(image.affine, fixed.affine, atol=1e-4):
            raise InputError(
                f"the {name} image must lie on the grid of the fixed image: shapes {image.shape} and {fixed.shape}, "
                f"affines {image.affine.tolist()} and {fixed.affine.tolist()}"
            )
    outside = int((~fixed.contains(mesh.points)).sum())
    if outside:
        raise InputError(f"{outside} of the {len(mesh.points)} nodes of the mesh lie off the grid of the fixed image")
