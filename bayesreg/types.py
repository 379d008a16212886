"""Define the aliases of arrays, and small containers and names that several packages share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int

if TYPE_CHECKING:
    # NumPy's and JAX's arrays share no base class; jaxtyping checks them while the tests run.
    AnyArray = Any
else:
    AnyArray = jax.Array | np.ndarray

# The environment variable that names a folder in which files are searched.
DATA_FOLDER = "BAYESREG_DATA"

# A matrix in NumPy's or SciPy's format, dense or sparse.
Matrix = np.ndarray | scipy.sparse.spmatrix

Scalar = Float[AnyArray, ""]
Points = Float[AnyArray, "nodes 3"]
Cells = Int[AnyArray, "cells 4"]
Tissue = Int[AnyArray, "cells"]


class Equilibrium(NamedTuple):
    """The displacement of every node, and the convergence of the elastic solve.

    Attributes
    ----------
    u : (n, 3) array
        Displacement of every node, mm.
    residual : scalar
        Relative residual ‖f − K_II u_I‖ / ‖f‖ of the interior solve.
    iterations : scalar integer
        The number of conjugate-gradient iterations.
    converged : scalar bool
        Whether all numbers are finite and the residual is below the tolerance.
    """

    u: Float[AnyArray, "nodes 3"]
    residual: Scalar
    iterations: Int[AnyArray, ""]
    converged: Bool[AnyArray, ""]


class InputError(ValueError):
    """An input of the user is wrong; the message names the error, its place, and the remedy.

    The command line prints only the message and exits with status 2. Any other exception is a bug, and its traceback is
    printed.
    """
