"""Array aliases, and the small containers and names that two floors share."""

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

# The environment variable that names a folder in which files are looked for.
DATA_FOLDER = "BAYESREG_DATA"

# On the host, dense or sparse.
Matrix = np.ndarray | scipy.sparse.spmatrix

Scalar = Float[AnyArray, ""]
Points = Float[AnyArray, "nodes 3"]
Cells = Int[AnyArray, "cells 4"]
Tissue = Int[AnyArray, "cells"]


class Equilibrium(NamedTuple):
    """Displacement of every node, and how well the elastic solve converged.

    Attributes
    ----------
    u : (n, 3) array
        Displacement of every node, mm.
    residual : scalar
        Relative residual ‖f − K_II u_I‖ / ‖f‖ of the interior solve.
    iterations : scalar integer
        Conjugate-gradient iterations.
    converged : scalar bool
        Whether everything is finite and the residual is below the tolerance.
    """

    u: Float[AnyArray, "nodes 3"]
    residual: Scalar
    iterations: Int[AnyArray, ""]
    converged: Bool[AnyArray, ""]


class InputError(ValueError):
    """Something that a user gave is wrong; the message says what, where, and what to do.

    The command line shows the message alone and ends with status 2. Any other exception is a bug, and
    shows its traceback.
    """
