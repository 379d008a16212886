"""World coordinates in RAS, as here and in NIfTI, and in LPS, as in ITK and DICOM: x and y differ in their signs.

All of bayesreg computes in RAS. Files and SimpleITK's objects in LPS are converted by what stands here, and there is no
other place where signs change. Every conversion is its own inverse.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from bayesreg.types import AnyArray

Space = Literal["RAS", "LPS"]

# Factors of x, y and z that convert points or vectors of a space to RAS.
TO_RAS = {"RAS": np.array([1.0, 1.0, 1.0]), "LPS": np.array([-1.0, -1.0, 1.0])}
LPS = TO_RAS["LPS"]
_HOMOGENEOUS = np.diag([*LPS, 1.0])


def convert_affine(affine: Float[AnyArray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Convert an affine from voxel indices to RAS into one to LPS, or back."""
    return _HOMOGENEOUS @ np.asarray(affine, float)


def convert_motion(matrix: Float[AnyArray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Convert an affine map of RAS coordinates into one of LPS coordinates, or back."""
    return _HOMOGENEOUS @ np.asarray(matrix, float) @ _HOMOGENEOUS
