"""Conversion between world coordinates in RAS (bayesreg, NIfTI) and LPS (ITK, DICOM); x and y change their signs.

All of bayesreg computes in RAS. Files and SimpleITK's objects in LPS are converted only by this module. Every
conversion is its own inverse.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from bayesreg.types import AnyArray

Space = Literal["RAS", "LPS"]

# Factors of x, y and z that convert points or vectors from a space to RAS.
TO_RAS = {"RAS": np.array([1.0, 1.0, 1.0]), "LPS": np.array([-1.0, -1.0, 1.0])}
LPS = TO_RAS["LPS"]
_HOMOGENEOUS = np.diag([*LPS, 1.0])


def convert_affine(affine: Float[AnyArray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Convert an affine from voxel indices to RAS into an affine to LPS, or back."""
    return _HOMOGENEOUS @ np.asarray(affine, float)


def convert_motion(matrix: Float[AnyArray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Convert an affine map of RAS coordinates into the same map of LPS coordinates, or back."""
    return _HOMOGENEOUS @ np.asarray(matrix, float) @ _HOMOGENEOUS
