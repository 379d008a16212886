"""Log densities, gradients and energies that the code before the reshaping by terms and blocks found.

`python -m tests.model.reference_densities` wrote the numbers beside this file, at commit 4e66e15. The test compares the
present code with them. Do not write them anew: they are the proof that a change of shape changed no number.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import bayesreg as br
from bayesreg.model.options import FieldConfig
from tests.options import posterior_of
from tests.phantoms import ball_mesh, flat_skull, smooth_image

FILE = Path(__file__).with_suffix(".npz")
STATES, TOLERANCE = 20, 1e-12
MESH = ball_mesh(spacing=24.0)
FIXED, MOVING = (smooth_image(MESH.points, seed=seed, left_handed=seed == 1) for seed in (1, 2))
PROPER = {name: br.PriorConfig(alpha=1.5, beta=2.0, low=0.0, high=high) for name, high in (("lam", 60.0), ("mu", 8.0))}
TEMPERED = {"t_similarity": 5.0, "t_elastic": 100.0}
HELD = {int(MESH.boundary[3]): (0.5, -1.0, 2.0), int(MESH.interior[2]): (1.5, 0.0, -0.5)}
KNOWN = {int(node): tuple(0.8 * np.sin(0.1 * MESH.points[node] + [0.0, 1.0, 2.0])) for node in MESH.boundary}

CASES: dict[str, dict[str, Any]] = {
    "tissue": TEMPERED,
    "uniform": TEMPERED | {"elasticity": "uniform", "rigid_sd": 3.0},
    "element": TEMPERED | {"elasticity": "element", "interpolation": "cubic"},
    "field": TEMPERED | {"elasticity": "field", "field": FieldConfig(correlation=25.0, modes=12), "priors": PROPER},
    "normalised": TEMPERED | {
        "normalised": True, "t_elastic": br.ScalePrior(median=100.0, log_sd=0.7), "priors": PROPER,
    },
    "student_t": TEMPERED | {
        "similarity": "student_t", "t_similarity": br.ScalePrior(median=5.0, log_sd=0.5),
        "quadrature": "gauss32", "independent_points": 900.0,
    },
    "held": TEMPERED | {"held": HELD, "quadrature": "voxels"},
    "known_boundary": TEMPERED | {"held": KNOWN, "sampled": [], "priors": PROPER},
}  # fmt: skip


def posterior_of_case(case: str) -> br.Posterior:
    """The posterior of a case, its solves to 1e-12."""
    skull = flat_skull(MESH.points, 2, float(MESH.points[:, 2].max()) + 9.0) if case in ("tissue", "held") else None
    posterior = posterior_of(FIXED, MOVING, MESH, skull, **CASES[case])
    body, tight = posterior.data.body, jnp.asarray(TOLERANCE)
    body = body._replace(system=body.system._replace(tolerance=tight, adjoint_tolerance=tight))
    return replace(posterior, data=posterior.data._replace(body=body))


def flat_positions(case: str, dimension: int) -> np.ndarray:
    """Random unconstrained states, (states, dimension): displacements come last and are in mm."""
    rng = np.random.default_rng(sorted(CASES).index(case))
    return rng.normal(scale=np.linspace(0.3, 1.2, STATES)[:, None], size=(STATES, dimension))


def densities(posterior: br.Posterior, case: str) -> dict[str, np.ndarray]:
    """Log density, gradient in the flat unconstrained position, and every term, at all states of a case."""
    flat, unravel = ravel_pytree(posterior.unconstrain(posterior.reference()))
    places = jnp.asarray(flat_positions(case, len(flat)))
    slope = jax.jit(jax.value_and_grad(lambda place: posterior.logdensity(unravel(place))))
    heights, slopes = zip(*map(slope, places), strict=True)
    values = [posterior.constrain(unravel(place)) for place in places]
    terms = [posterior.energies(value) for value in values]
    arrays = {
        "logdensity": np.array(heights),
        "gradient": np.array(slopes),
        "constrained": np.array([posterior.logdensity_constrained(value) for value in values]),
    }
    return arrays | {name: np.array([term[name] for term in terms]) for name in terms[0]}


def main() -> None:
    """Write the reference numbers of all cases."""
    numbers = {
        f"{case}/{name}": value for case in CASES for name, value in densities(posterior_of_case(case), case).items()
    }
    np.savez_compressed(FILE, **numbers)


if __name__ == "__main__":
    main()
