"""The starting point of a search from SimpleITK: a field from Demons."""

from __future__ import annotations

import numpy as np
import SimpleITK

from bayesreg.image import Image
from bayesreg.io.itk import from_itk, to_itk
from bayesreg.io.spaces import LPS

# For each level of Demons: factor by which each axis is coarsened, and number of iterations.
DEMONS = ((4, 200), (2, 100), (1, 50))


def find_demons(fixed: Image, moving: Image) -> tuple[Image, Image, Image]:
    """Find the displacement between two aligned images of one contrast by diffeomorphic Demons.

    The search has three levels and smooths the field by 1.5 voxels after each iteration. The histogram of the moving
    image is first matched to that of the fixed image, since Demons compare intensities. (Vercauteren et al. 2009,
    "Diffeomorphic demons: efficient non-parametric image registration".)

    Returns
    -------
    tuple of Image
        The x, y and z components of the displacement, mm, world RAS.
    """
    fixed_image, moving_image = (
        to_itk(image, "float32") for image in (fixed.on_orthogonal_grid(), moving.on_orthogonal_grid())
    )
    moving_image = SimpleITK.Resample(moving_image, fixed_image, SimpleITK.Transform(), SimpleITK.sitkLinear, 0.0)
    moving_image = SimpleITK.HistogramMatching(moving_image, fixed_image, 256, 15, True)
    field = None
    for factor, iterations in DEMONS:
        level = [_thinned(image, factor) for image in (fixed_image, moving_image)]
        method = SimpleITK.DiffeomorphicDemonsRegistrationFilter()
        method.SetNumberOfIterations(iterations)
        method.SetSmoothDisplacementField(True)
        method.SetStandardDeviations(1.5)
        field = method.Execute(*level) if field is None else method.Execute(*level, SimpleITK.Resample(field, level[0]))
    assert field is not None
    volume = from_itk(field)
    x, y, z = (Image(values, volume.affine) for values in np.moveaxis(volume.voxels * LPS, -1, 0))
    return x, y, z


def _thinned(image: SimpleITK.Image, factor: int) -> SimpleITK.Image:
    """Smooth an image and keep every n-th voxel along each axis, with n the factor."""
    if factor == 1:
        return image
    sd = [factor / 2 * size for size in image.GetSpacing()]
    return SimpleITK.Shrink(SimpleITK.SmoothingRecursiveGaussian(image, sd), [factor] * 3)
