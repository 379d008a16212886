"""The two ways in which programs count world coordinates: RAS, as here and in NIfTI, and LPS, as in ITK and DICOM."""

from typing import Literal

import numpy as np

Space = Literal["RAS", "LPS"]

# Factors that take x, y, z from one to RAS; each is its own inverse.
TO_RAS = {"RAS": np.array([1.0, 1.0, 1.0]), "LPS": np.array([-1.0, -1.0, 1.0])}
LPS = TO_RAS["LPS"]
