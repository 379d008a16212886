"""How large is the error of λ/μ from the mesh alone, without images and without noise?

A patch is pushed on a fine mesh. On each other mesh the true displacement of the boundary is prescribed, and λ and μ of
all tissues (except for μ of GM, which is known) are fitted to the true displacement inside, weighted by volume.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.sparse.linalg import spsolve

import bayesreg as br
from bayesreg.fem.elasticity import stiffness
from bayesreg.fem.location import transfer
from bayesreg.synthetic.deformation import push_patch
from studies.calibration import pairs

EDGES = (13.0, 15.5, 18.0, 22.0)
SEEDS = (1, 2, 3)
GM, WM = 1, 2


def measure(out: Path, report_progress: Callable[[str], None] = print) -> dict[str, Any]:
    """Fit λ/μ of GM and WM on each mesh; the mesh of the body must recover them, the others have no bound."""
    making, *others = pairs.meshes(out, (pairs.MAKING_EDGE, *EDGES))
    skull, options = pairs.skull(), pairs.push(making)
    bodies = {}
    for seed in SEEDS:
        body, _ = pairs.upwards(seed, lambda way: push_patch(making, skull, direction=way, **options))
        bodies[seed] = body.u
    results: dict[str, Any] = {}
    for name, mesh in zip((pairs.MAKING_EDGE, *EDGES), (making, *others), strict=True):
        ratios = []
        for seed in SEEDS:
            u = bodies[seed]
            ratios.append(fitted(mesh, u if mesh is making else transfer(u, making, mesh.points)))
        results[f"{name:g} mm"] = {
            "as_it_should": mesh is not making or np.allclose(ratios, list(pairs.truth().values()), rtol=1e-2),
            "nodes": len(mesh.points),
            "gm": [ratio[0] for ratio in ratios],
            "wm": [ratio[1] for ratio in ratios],
        }
        text = "; ".join(f"GM {gm:.1f}, WM {wm:.1f}" for gm, wm in ratios)
        report_progress(f"mesh of {len(mesh.points)} nodes ({name:g} mm): {text}")
    return results


def fitted(mesh: br.TetMesh, u: Float[np.ndarray, "nodes 3"]) -> tuple[float, float]:
    """Fit λ/μ of GM and WM so that the equilibrium, with the boundary displaced as in u, is nearest to u inside."""
    free, held = ((3 * nodes[:, None] + np.arange(3)).ravel() for nodes in (mesh.interior, mesh.boundary))
    unit, nothing = np.eye(3), np.zeros(3)
    unit_matrices = [stiffness(mesh, *pair) for pair in [(e, nothing) for e in unit] + [(nothing, e) for e in unit]]
    inner, load = [K[free][:, free] for K in unit_matrices], [K[free][:, held] @ u.ravel()[held] for K in unit_matrices]
    volume = np.bincount(mesh.cells.ravel(), np.repeat(mesh.volumes / 4, 4), len(mesh.points))
    weight = np.sqrt(np.repeat(volume[mesh.interior], 3))

    def parameters(z: np.ndarray) -> np.ndarray:
        # λ of the three tissues, μ of CSF, one, μ of WM.
        return np.insert(np.exp(z), 3 + GM, 1.0)

    def misfit(z: np.ndarray) -> np.ndarray:
        theta = parameters(z)
        K = sum(value * matrix for value, matrix in zip(theta, inner, strict=True))
        force = sum(value * matrix for value, matrix in zip(theta, load, strict=True))
        return weight * (spsolve(K.tocsc(), -force) - u.ravel()[free])

    first = np.log([1e-3, *pairs.TRUE_LAM[GM:], 1e-3, pairs.TRUE_MU[WM]])
    best = parameters(least_squares(misfit, first, bounds=np.log([1e-7, 1e4]), diff_step=1e-3).x)
    return float(best[GM] / best[3 + GM]), float(best[WM] / best[3 + WM])
