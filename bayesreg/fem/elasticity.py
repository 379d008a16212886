"""Strain energy and stiffness of isotropic linear elasticity, which are affine in the Lamé parameters.

K(λ, μ) = Σ_t λ_t A_t + μ_t B_t, with one pair of matrices for each tissue (or each cell).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from bayesreg.columns import with_chains_as_columns
from bayesreg.fem.elements import Elements, Gradient, displacement_gradient, elements_of, shape_gradients
from bayesreg.fem.operators import SparseOperator
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray, InputError, Scalar


def lame_by_cell(values: Float[AnyArray, "entries"], mesh: TetMesh) -> Float[AnyArray, "cells"]:
    """Spread a Lamé parameter over the cells.

    Parameters
    ----------
    values : (1,), (T,) or (m,) array
        The parameter: uniform, by tissue in the order of `mesh.names`, or by cell.

    Raises
    ------
    InputError
        If `values` has another shape.
    """
    return jnp.asarray(values)[lame_entries(mesh, np.shape(values))]


def lame_entries(mesh: TetMesh, shape: tuple[int, ...]) -> np.ndarray:
    """Find the entry of each cell in a uniform (1,), by-tissue (T,) or by-cell (m,) parameter vector."""
    if shape == (len(mesh.names),):
        return mesh.tissue
    if shape == (len(mesh.cells),):
        return np.arange(len(mesh.cells))
    if shape == (1,):
        return np.zeros(len(mesh.cells), int)
    raise InputError(
        f"a Lamé parameter has shape ({len(mesh.names)},) by tissue {mesh.names}, ({len(mesh.cells)},) by cell "
        f"or (1,) uniform; got {shape}"
    )


def strain_energy_density(
    elements: Elements,
    lam: Float[AnyArray, "cells"],
    mu: Float[AnyArray, "cells"],
    u: Float[AnyArray, "nodes 3"],
) -> Float[AnyArray, "cells"]:
    """Compute μ/4 Σ_jk (∂_j u_k + ∂_k u_j)² + λ/2 (div u)² in each cell: eq. (2), which equals eq. (3)."""
    gradient = displacement_gradient(elements.derivative, u)
    dilatation, distortion = strain_products(gradient, gradient)
    return (lam * dilatation + mu * distortion) / 2


def strain_products(
    first: Gradient, second: Gradient
) -> tuple[Float[AnyArray, "cells *chains"], Float[AnyArray, "cells *chains"]]:
    """Compute div u · div w and ½ (∇u + ∇uᵀ) : (∇w + ∇wᵀ) of each cell, given ∇u and ∇w (`displacement_gradient`).

    uᵀ K w is the integral of λ times the first plus μ times the second.
    """
    divergence = [g[0][0] + g[1][1] + g[2][2] for g in (first, second)]
    stretch = sum(first[i][i] * second[i][i] for i in range(3))
    shear = sum((first[i][j] + first[j][i]) * (second[i][j] + second[j][i]) for i, j in ((0, 1), (0, 2), (1, 2)))
    return divergence[0] * divergence[1], 2 * stretch + shear


@jax.custom_jvp
def total_strain_energy(elements: Elements, lam: AnyArray, mu: AnyArray, u: AnyArray) -> Scalar:
    """Compute E_r of eq. (3) for λ and μ by cell; differentiable in λ, μ and u."""
    return elements.volumes @ strain_energy_density(elements, lam, mu, u)


@total_strain_energy.defjvp
def _strain_energy_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Scalar, Scalar]:
    """Differentiate E_r: ∂E_r/∂u = K u, ∂E_r/∂λ = V (div u)²/2."""
    elements, lam, mu, u = primals
    _, d_lam, d_mu, d_u = tangents
    gradient = displacement_gradient(elements.derivative, u)
    dilatation, distortion = strain_products(gradient, gradient)
    energy = elements.volumes @ (lam * dilatation + mu * distortion) / 2
    by_parameters = elements.volumes @ (d_lam * dilatation + d_mu * distortion) / 2
    return energy, by_parameters + (internal_force(elements, lam, mu, u) * d_u).sum()


def internal_force(
    elements: Elements,
    lam: Float[AnyArray, "cells"],
    mu: Float[AnyArray, "cells"],
    u: Float[AnyArray, "nodes 3"],
) -> Float[AnyArray, "nodes 3"]:
    """Compute K(λ, μ) u of eq. (7): Σ_e V_e σ ∇N_a."""
    return force_between(elements.derivative, elements.derivative, elements.volumes, lam, mu, u)


@jax.custom_jvp
def force_between(
    on: SparseOperator,
    of: SparseOperator,
    volumes: Float[AnyArray, "cells"],
    lam: Float[AnyArray, "cells"],
    mu: Float[AnyArray, "cells"],
    u: Float[AnyArray, "moved 3"],
) -> Float[AnyArray, "held 3"]:
    """Compute the forces on some nodes while others move by u: a block of K(λ, μ) times u.

    Parameters
    ----------
    on, of : SparseOperator
        The columns of `Elements.derivative` that belong to the nodes with forces, and to the nodes that move.
    """
    return _side_by_side((on, of, volumes), *(x[..., None] for x in (lam, mu, u)))[..., 0]


@force_between.defjvp
def _force_between_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[AnyArray, AnyArray]:
    # Functions with chains as columns have no derivative, so the same formula without this wrapper is differentiated.
    *shared, lam, mu, u = primals

    def force(*arguments: AnyArray) -> AnyArray:
        return forces(*shared, *(x[..., None] for x in arguments))[..., 0]

    return jax.jvp(force, (lam, mu, u), tangents[3:])


@with_chains_as_columns
def _side_by_side(
    shared: tuple[SparseOperator, SparseOperator, AnyArray], lam: AnyArray, mu: AnyArray, u: AnyArray
) -> AnyArray:
    return forces(*shared, lam, mu, u)


def forces(
    on: SparseOperator,
    of: SparseOperator,
    volumes: Float[AnyArray, "cells"],
    lam: Float[AnyArray, "cells chains"],
    mu: Float[AnyArray, "cells chains"],
    u: Float[AnyArray, "moved 3 chains"],
) -> Float[AnyArray, "held 3 chains"]:
    """Compute `force_between` of many chains: Gᵀ V σ(G u), where G is the derivative.

    Hooke's law is σ = μ (∇u + ∇uᵀ) + λ (div u) I.
    """
    gradient = of(u.reshape(len(u), -1)).reshape(3, -1, *u.shape[1:])
    divergence = gradient[0, :, 0] + gradient[1, :, 1] + gradient[2, :, 2]
    dilatational = (lam * divergence)[:, None] * jnp.eye(3)[:, None, :, None]
    stress = volumes[:, None, None] * (mu[:, None] * (gradient + jnp.swapaxes(gradient, 0, 2)) + dilatational)
    return on.transpose(stress.reshape(3 * len(volumes), -1)).reshape(-1, *u.shape[1:])


def stiffness_diagonal(
    derivative: SparseOperator,
    volumes: Float[AnyArray, "cells"],
    lam: Float[AnyArray, "cells chains"],
    mu: Float[AnyArray, "cells chains"],
) -> Float[AnyArray, "nodes 3 chains"]:
    """Compute the diagonal of K(λ, μ) for each node and axis: Σ_e V_e ((λ + μ) (∂_i N_a)² + μ |∇N_a|²).

    Parameters
    ----------
    derivative : SparseOperator
        `Elements.derivative`, or its columns that belong to the nodes of the result.
    """
    squares = SparseOperator(*(matrix._replace(entries=matrix.entries**2) for matrix in derivative))
    same_axis = (lam + mu)[:, None] * jnp.eye(3)[:, None, :, None]
    entries = volumes[:, None, None] * (mu[:, None] + same_axis)
    return squares.transpose(entries.reshape(3 * len(volumes), -1)).reshape(-1, 3, lam.shape[1])


def element_stiffness(
    elements: Elements, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"]
) -> Float[AnyArray, "4 3 4 3 cells"]:
    """Compute K_e = V BᵀCB of eq. (6); its block (a, b) is V (λ g_a g_bᵀ + μ (g_b g_aᵀ + (g_a · g_b) I))."""
    gradients = elements.gradients
    outer = gradients[:, :, None, None] * gradients
    inner = (gradients[:, None] * gradients[None]).sum(axis=2)
    shear = jnp.swapaxes(outer, 1, 3) + inner[:, None, :, None] * jnp.eye(3)[None, :, None, :, None]
    return elements.volumes * (lam * outer + mu * shear)


def strain_energy(
    mesh: TetMesh, lam: Float[AnyArray, "entries"], mu: Float[AnyArray, "entries"], u: Float[AnyArray, "nodes 3"]
) -> Scalar:
    """Compute the linear elastic strain energy E_r = ½ ∫ εᵀ C ε dx (eq. 3).

    Parameters
    ----------
    mesh : TetMesh
    lam, mu : (T,), (m,) or (1,) array
        Lamé parameters by tissue, by cell or uniform.
    u : (n, 3) array
        Displacement of every node, mm.

    Returns
    -------
    scalar
        E_r in (unit of λ, μ) · mm³, differentiable in `lam`, `mu` and `u`.

    Raises
    ------
    InputError
        If a shape does not fit the mesh.
    """
    if np.shape(u) != mesh.points.shape:
        raise InputError(f"u must have shape {mesh.points.shape}, got {np.shape(u)}")
    return total_strain_energy(elements_of(mesh), lame_by_cell(lam, mesh), lame_by_cell(mu, mesh), jnp.asarray(u))


def unknowns_of(nodes: Int[AnyArray, "*shape"]) -> Int[np.ndarray, "unknowns"]:
    """List the rows of K that belong to nodes: 3 · node + axis, axes fastest."""
    return (3 * np.asarray(nodes)[..., None] + np.arange(3)).ravel()


def stiffness(mesh: TetMesh, lam: AnyArray, mu: AnyArray) -> scipy.sparse.csr_matrix:
    """Assemble the global stiffness matrix K of eq. (7) on the host.

    Parameters
    ----------
    mesh : TetMesh
    lam, mu : (T,), (m,) or (1,) array
        Lamé parameters by tissue, by cell or uniform.

    Returns
    -------
    (3n, 3n) sparse matrix
        K, with row 3 · node + axis. It is symmetric, and its null space contains the six rigid motions.
    """
    gradients = shape_gradients(mesh)
    lam_volume, mu_volume = (
        np.asarray(values)[lame_entries(mesh, np.shape(values))] * mesh.volumes for values in (lam, mu)
    )
    # V BᵀCB of eq. (6), block (a, b): λ g_a g_bᵀ + μ (g_b g_aᵀ + (g_a · g_b) I).
    outer = np.einsum("mai,mbj->maibj", gradients, gradients)
    inner = np.einsum("mak,mbk,ij->maibj", gradients, gradients, np.eye(3))
    shear = np.einsum("majbi->maibj", outer) + inner
    blocks = lam_volume[:, None, None, None, None] * outer + mu_volume[:, None, None, None, None] * shear
    degrees = unknowns_of(mesh.cells).reshape(-1, 12)
    rows, columns = np.repeat(degrees, 12, axis=1), np.tile(degrees, (1, 12))
    size = 3 * len(mesh.points)
    return scipy.sparse.csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))


def rigid_modes(points: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "rows 6"]:
    """Compute an orthonormal basis of the translations and infinitesimal rotations of points about their centroid."""
    centred = points - points.mean(axis=0)
    translations = np.tile(np.eye(3), (len(points), 1))
    rotations = np.stack([np.cross(axis, centred).ravel() for axis in np.eye(3)], axis=1)
    basis, triangle = np.linalg.qr(np.concatenate([translations, rotations], axis=1))
    independent = np.abs(np.diag(triangle)) > 1e-9 * np.abs(triangle).max()
    return basis * independent
