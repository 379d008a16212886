"""A Gaussian Markov random field of log-stiffness on the graph of the elements that share a face.

The field s multiplies λ and μ of an element by e^s: it makes tissue stiffer or softer and leaves ν unchanged. It has
the Matérn covariance of smoothness ½ in space, sd² exp(−κr), through the stochastic equation of Lindgren, Rue and
Lindström (2011), (κ² − Δ) s = white noise, in finite volumes. With the elements' volumes V and the weights w_ef = area
of the common face / distance of the centroids in the graph's Laplacian G, the precision is

Q = (κ²V + G) V⁻¹ (κ²V + G) / (8πκ sd²).

The weights make the field the same on every mesh; a plain graph Laplacian would couple small elements as strongly as
large ones. At the surface the flux of the equation is zero, and the variance rises to almost twice its value inside.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Float
from pydantic import Field

from bayesreg.mesh import TetMesh
from bayesreg.settings import Positive, Section
from bayesreg.types import AnyArray, InputError, Scalar

# With more elements than this, the dense covariance (8 bytes × their square, several times) exceeds the memory.
DENSE_LIMIT = 8000


class FieldConfig(Section):
    """Prior of the field of log-stiffness for `elasticity: field`; see `bayesreg.model.field`.

    Attributes
    ----------
    correlation : float
        Distance, mm, at which the correlation of the log-stiffness of two places has fallen to 0.14.
    sd : float
        Scale of the half-normal prior of the field's standard deviation, which is inferred; 0.5 is a factor of e^0.5.
    modes : int
        The greatest number of sampled principal components of the field.
    """

    correlation: Positive = 20.0
    sd: Positive = 0.5
    modes: Annotated[int, Field(strict=True, ge=1)] = 300


class StiffnessField(NamedTuple):
    """The prior of the log-stiffness of every element, s = sd · basis · z with z ~ N(0, I) (a pytree).

    Attributes
    ----------
    basis : (m, k) array
        Leading principal components of the field with sd 1, times their standard deviations.
    sd_scale : scalar
        The scale of the half-normal prior of sd.
    share : scalar
        The share of the field's variance, averaged over the volume, that the k components carry.
    """

    basis: Float[AnyArray, "cells modes"]
    sd_scale: Scalar
    share: Scalar


def stiffness_field(mesh: TetMesh, options: FieldConfig) -> StiffnessField:
    """Make the field on a mesh, conditioned on a mean of zero in every tissue.

    Then λ and μ of a tissue are its geometric mean stiffness, and the field describes the variation inside it. Without
    this condition, only the prior would distinguish a shift of the field from a change of the tissue's μ.

    Raises
    ------
    InputError
        If the mesh has more elements than a dense covariance can serve.
    """
    count = len(mesh.cells)
    if count > DENSE_LIMIT:
        raise InputError(
            f"model.elasticity field needs a mesh of at most {DENSE_LIMIT:,} elements, this one has {count:,}; "
            "give a longer mesh.edge_length"
        )
    covariance = _condition(scipy.linalg.inv(precision(mesh, options.correlation).toarray()), _tissue_means(mesh))
    # The k components with the largest mean square over the volume.
    root = np.sqrt(mesh.volumes)
    weighted = root[:, None] * covariance * root
    modes = min(options.modes, count - len(np.unique(mesh.tissue)))
    values, vectors = scipy.linalg.eigh(weighted, subset_by_index=(count - modes, count - 1))
    basis = (vectors * np.sqrt(np.maximum(values, 0.0)) / root[:, None])[:, ::-1]
    share = values.sum() / np.trace(weighted)
    return StiffnessField(jnp.asarray(basis), jnp.asarray(options.sd), jnp.asarray(share))


def precision(mesh: TetMesh, correlation: float) -> scipy.sparse.csr_matrix:
    """Compute Q of the field with sd = 1 inside, before conditioning; sparse: an element, its neighbours, and theirs.

    Parameters
    ----------
    mesh : TetMesh
    correlation : float
        2/κ, mm: the distance at which the correlation has fallen to e⁻² = 0.14.
    """
    kappa, volumes = 2 / correlation, mesh.volumes
    operator = scipy.sparse.diags(kappa**2 * volumes) + face_laplacian(mesh)
    return (operator @ scipy.sparse.diags(1 / volumes) @ operator / (8 * np.pi * kappa)).tocsr()


def face_laplacian(mesh: TetMesh) -> scipy.sparse.csr_matrix:
    """Compute G: sᵀGs = Σ w_ef (s_e − s_f)² over pairs of elements that share a face ≈ ∫|∇s|², in mm."""
    cells, neighbours = mesh.neighbours.T
    corners = mesh.cells[cells]
    shared = (corners[:, :, None] == mesh.cells[neighbours][:, None, :]).any(axis=2)
    faces = mesh.points[corners[shared].reshape(-1, 3)]
    areas = np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1) / 2
    centres = mesh.points[mesh.cells].mean(axis=1)
    weights = areas / np.linalg.norm(centres[cells] - centres[neighbours], axis=1)
    size = len(mesh.cells)
    coupling = scipy.sparse.coo_matrix((weights, (cells, neighbours)), shape=(size, size)).tocsr()
    coupling = coupling + coupling.T
    return (scipy.sparse.diags(np.asarray(coupling.sum(axis=1)).ravel()) - coupling).tocsr()


def _tissue_means(mesh: TetMesh) -> Float[np.ndarray, "tissues cells"]:
    """Return rows that take the mean over the volume of each tissue that occurs in the mesh."""
    rows = [(mesh.tissue == tissue) * mesh.volumes for tissue in np.unique(mesh.tissue)]
    return np.array([row / row.sum() for row in rows])


def _condition(
    covariance: Float[np.ndarray, "cells cells"], C: Float[np.ndarray, "tissues cells"]
) -> Float[np.ndarray, "cells cells"]:
    """Compute the covariance given C s = 0."""
    cross = covariance @ C.T
    return covariance - cross @ np.linalg.solve(C @ cross, cross.T)
