"""Errors of a registration against a known truth, in plain NumPy: Tables 1 and 2 of the paper, and coverage."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from bayesreg.io.records import Truth
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray

COVERAGE_LEVELS = (0.5, 0.9, 0.95)
WHOLE = "domain"


def squared_integral(mesh: TetMesh, field: Float[AnyArray, "nodes 3"]) -> Float[np.ndarray, "cells"]:
    """Integrate |e|² over every tetrahedron for a piecewise linear field, exactly.

    Parameters
    ----------
    mesh : TetMesh
    field : (n, 3) array
        Nodal values e, mm.

    Returns
    -------
    (m,) array, mm⁵
        The P1 mass matrix of a tetrahedron of volume V is V/20 (1 + δ_ij), hence V/20 (Σ|e_i|² + |Σ e_i|²).
    """
    corner = np.asarray(field)[mesh.cells]
    return mesh.volumes / 20 * ((corner**2).sum(axis=(1, 2)) + (corner.sum(axis=1) ** 2).sum(axis=1))


def divergence(mesh: TetMesh, u: Float[AnyArray, "nodes 3"]) -> Float[np.ndarray, "cells"]:
    """Compute div u in every tetrahedron: the relative change of volume to first order."""
    points, u = mesh.points[mesh.cells], np.asarray(u, float)[mesh.cells]
    # Row i of both arrays: an edge vector, and the difference of u along it.
    gradient = np.linalg.solve(points[:, 1:] - points[:, :1], u[:, 1:] - u[:, :1])
    return np.trace(gradient, axis1=1, axis2=2)


def mean_squared_error(
    mesh: TetMesh, u: Float[AnyArray, "nodes 3"], truth: Float[AnyArray, "nodes 3"]
) -> dict[str, float]:
    """Compute ∫_Ωl |u − truth|² / |Ω_l| for the "domain" and each tissue in the mesh, mm² (Table 2)."""
    integral = squared_integral(mesh, np.asarray(u) - np.asarray(truth))
    result = {WHOLE: float(integral.sum() / mesh.volumes.sum())}
    for index, name in enumerate(mesh.names):
        inside = mesh.tissue == index
        if inside.any():
            result[name] = float(integral[inside].sum() / mesh.volumes[inside].sum())
    return result


def boundary_error(
    u: Float[AnyArray, "nodes 3"], truth: Float[AnyArray, "nodes 3"], nodes: Int[AnyArray, "boundary"]
) -> dict[str, float]:
    """Compute the median, 95 % quantile and maximum of |u − truth| over the given nodes, mm (Table 1)."""
    distance = np.linalg.norm(np.asarray(u)[nodes] - np.asarray(truth)[nodes], axis=1)
    median, q95, greatest = np.quantile(distance, (0.5, 0.95, 1.0))
    return {"median": float(median), "q95": float(q95), "max": float(greatest)}


def coverage(draws: Float[AnyArray, "draws *shape"], truth: Float[AnyArray, "*shape"]) -> dict[str, float]:
    """Compute the share of moving entries whose truth lies in the central 50, 90 and 95 % intervals."""
    draws, truth = np.asarray(draws), np.asarray(truth)
    moves = np.ptp(draws, axis=0) > 0
    draws, truth = draws[:, moves], truth[moves]
    result = {}
    for level in COVERAGE_LEVELS:
        low, high = np.quantile(draws, (0.5 - level / 2, 0.5 + level / 2), axis=0)
        result[f"{level:g}"] = float(np.mean((low <= truth) & (truth <= high))) if truth.size else float("nan")
    return result


def compute_metrics(
    mesh: TetMesh,
    u_mean: Float[AnyArray, "nodes 3"],
    truth: Truth,
    posterior: xr.Dataset,
    max_draws: int = 2000,
) -> dict[str, Any]:
    """Compute the content of metrics.json.

    Parameters
    ----------
    mesh : TetMesh
    u_mean : (n, 3) array
        Posterior mean of u at every node, mm.
    truth : Truth
    posterior : xarray.Dataset
        Draws, of which `u_boundary` (chain, draw, node, axis) is used; its coordinate `node` holds mesh node indices.
    max_draws : int
        Intervals are taken from at most about this many draws, evenly spaced.

    Returns
    -------
    dict
        "boundary_error" (mm) and "mean_squared_error" (mm²) of the "initial" (start of the chains, or no motion),
        the "unregistered" (no motion) and the "posterior_mean" displacement; "coverage" of the intervals of u_boundary,
        empty where none of it was sampled.
    """
    unmoved = np.zeros_like(np.asarray(truth.u, float))
    initial = unmoved if truth.initial is None else truth.initial
    fields = {"unregistered": unmoved, "initial": initial, "posterior_mean": u_mean}
    return {
        "boundary_error": {name: boundary_error(u, truth.u, mesh.boundary) for name, u in fields.items()},
        "mean_squared_error": {name: mean_squared_error(mesh, u, truth.u) for name, u in fields.items()},
        "coverage": coverage(*_boundary_draws(posterior, truth, max_draws)) if posterior.sizes["node"] else {},
    }


def _boundary_draws(posterior: xr.Dataset, truth: Truth, max_draws: int) -> tuple[np.ndarray, np.ndarray]:
    draws = posterior["u_boundary"]
    stride = max(1, draws.sizes["chain"] * draws.sizes["draw"] // max_draws)
    values = draws.isel(draw=slice(None, None, stride)).transpose("chain", "draw", "node", "axis").to_numpy()
    return values.reshape(-1, *values.shape[2:]), np.asarray(truth.u)[draws["node"].to_numpy().astype(int)]
