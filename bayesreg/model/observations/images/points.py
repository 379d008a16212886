"""The points at which two images are compared."""

from __future__ import annotations

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from bayesreg.fem.elements import GAUSS_SUBDIVISIONS, Quadrature, gauss_quadrature, quadrature_at
from bayesreg.fem.location import locate
from bayesreg.ignored import ignored_voxels
from bayesreg.image import Image
from bayesreg.interpolation import Interpolator
from bayesreg.mesh import TetMesh
from bayesreg.model.observations.images.options import ImageOptions
from bayesreg.types import InputError


def visibility(image: Image, ignore: Image) -> Interpolator:
    """Return a function of the place that is 1 where an image is compared and 0 where it is ignored.

    The neighbours of an ignored voxel are ignored, too: they may contain a part of the same structure.
    """
    ignored = ndimage.binary_dilation(ignored_voxels(image, ignore), ndimage.generate_binary_structure(3, 3))
    return image.with_voxels(1.0 - ignored).interpolator("linear")


def require_overlap(mesh: TetMesh, image: Image, name: str) -> None:
    """Raise InputError if less than half of the mesh's nodes lie on the image's grid."""
    inside = image.contains(mesh.points)
    if inside.mean() < 0.5:
        corners = image.voxel_to_world(np.array([(0, 0, 0), np.array(image.shape) - 1]))
        raise InputError(
            f"the {name} and the mesh do not overlap: {inside.sum()} of {len(inside)} nodes lie on its grid. It runs "
            f"from {corners[0].round(1).tolist()} to {corners[1].round(1).tolist()} mm (world RAS), the mesh from "
            f"{mesh.points.min(0).round(1).tolist()} to {mesh.points.max(0).round(1).tolist()} mm; "
            "check the affines, or align the images first"
        )


def quadrature_of(mesh: TetMesh, fixed: Image, options: ImageOptions) -> Quadrature:
    """Make the quadrature rule that the options name.

    Raises
    ------
    InputError
        If the rule is "voxels" and no voxel centre lies inside the mesh.
    """
    if options.quadrature in GAUSS_SUBDIVISIONS:
        return gauss_quadrature(mesh, options.quadrature)
    return _voxels_of(mesh, fixed, options.most_points)


@lru_cache(maxsize=4)
def _voxels_of(mesh: TetMesh, fixed: Image, most: int | None) -> Quadrature:
    """Make the rule of voxel centres; a map of intensities uses it, too."""
    centres = fixed.grid_points().reshape(-1, 3)
    near = centres[((centres >= mesh.points.min(axis=0)) & (centres <= mesh.points.max(axis=0))).all(axis=1)]
    cells, barycentric = locate(mesh.points, mesh.cells, near)
    inside = cells >= 0
    if not inside.any():
        raise InputError("no voxel centre of the fixed image lies inside the mesh: quadrature 'voxels' has no points")
    chosen = np.flatnonzero(inside)
    volume = fixed.voxel_volume * len(chosen)
    if most is not None and len(chosen) > most:
        chosen = np.sort(np.random.default_rng(0).choice(chosen, most, replace=False))
    return quadrature_at(mesh, cells[chosen], barycentric[chosen], np.full(len(chosen), volume / len(chosen)))


def is_seen(
    mesh: TetMesh, quadrature: Quadrature, moving: Image, visible: Interpolator | None = None
) -> Bool[np.ndarray, "points"]:
    """Return which points are visible and lie on the grid of the moving image at rest; elsewhere nothing was observed.

    The choice of points must not depend on the displacement: the posterior could then exclude points that do not fit.
    """
    positions = quadrature.positions(mesh)
    seen = moving.contains(positions)
    if visible is not None:
        seen &= np.asarray(visible(jnp.asarray(positions))) > 0.5
    return seen


def seen_points(
    mesh: TetMesh, quadrature: Quadrature, moving: Image, visible: Interpolator | None = None
) -> Quadrature:
    """Return the points of `is_seen`.

    Raises
    ------
    InputError
        If none is left.
    """
    seen = is_seen(mesh, quadrature, moving, visible)
    if not seen.any():
        raise InputError("nothing is left to compare: all of the mesh lies in fixed_ignore, or beyond the moving image")
    if seen.all():
        return quadrature
    visible_arrays = (
        np.asarray(array)[seen] for array in (quadrature.cells, quadrature.barycentric, quadrature.weights)
    )
    return quadrature_at(mesh, *visible_arrays)
