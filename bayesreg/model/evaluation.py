"""Evaluation of the NumPyro program: its log density, its terms, and intermediate results."""

from __future__ import annotations

from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int
from numpyro.infer.util import log_density

from bayesreg.model.program import Problem, registration
from bayesreg.types import AnyArray, Scalar

# NumPyro keeps the handlers of all threads in one stack, and JAX may trace the program in two threads at a time.
_ONE_THREAD = Lock()


class Evaluation(NamedTuple):
    """The log density of one state, with intermediate results of its computation.

    Attributes
    ----------
    logdensity : scalar
        log p(u, λ, μ | m) up to a constant; −∞ outside the support and where the solve failed.
    u : (n, 3) array
        Displacement of every node, mm.
    similarity_energy, strain_energy : scalars
        E_s, summed over the pairs of images, and E_r; with "student_t" E_s is −T_s times the log of the likelihood
        without its normaliser.
    solver_iterations : scalar integer
    solver_failed, outside_support : scalar bools
        Whether the elastic solve failed; whether a sampled node lies in Ω_SK or a parameter outside the
        range of its prior.
    """

    logdensity: Scalar
    u: Float[AnyArray, "nodes 3"]
    similarity_energy: Scalar
    strain_energy: Scalar
    solver_iterations: Int[AnyArray, ""]
    solver_failed: Bool[AnyArray, ""]
    outside_support: Bool[AnyArray, ""]


@jax.jit
def evaluate(
    problem: Problem, values: dict[str, AnyArray], guess: Float[AnyArray, "nodes 3"] | None = None
) -> Evaluation:
    """Evaluate the log density at some values; a `guess` of u saves iterations but removes the derivative."""
    total, trace = _trace(problem, values, guess)
    names = ("u", "strain_energy", "solver_iterations", "solver_failed", "outside_support")
    quantities = {name: trace[name]["value"] for name in names}
    # Any NaN counts as a failure and becomes −∞, so that no sampler can move there.
    return Evaluation(
        logdensity=jnp.where(jnp.isnan(total), -jnp.inf, total),
        similarity_energy=_similarity_energy(trace),
        **quantities,
    )


@jax.jit
def terms(problem: Problem, values: dict[str, AnyArray]) -> dict[str, Scalar]:
    """Return every factor of the density by name, and the energies."""
    _, trace = _trace(problem, values)
    factors = {"similarity_energy": _similarity_energy(trace), "strain_energy": trace["strain_energy"]["value"]}
    for name in (*problem.terms, "support", "solved"):
        factors[name] = trace[name]["fn"].log_prob(trace[name]["value"]).sum()
    for name, block in problem.blocks.items():
        if block.is_sampled and name != "u_boundary":
            factors[f"prior_{name}"] = trace[name]["fn"].log_prob(values[name])
    return factors


def _trace(
    problem: Problem, values: dict[str, AnyArray], guess: Float[AnyArray, "nodes 3"] | None = None
) -> tuple[Scalar, dict[str, Any]]:
    """Run the program at some values; return its log density and its sites."""
    with _ONE_THREAD:
        return log_density(registration, (problem, guess), {}, values)


def _similarity_energy(trace: dict[str, Any]) -> Scalar:
    sites = (site for site in trace.values() if hasattr(site.get("fn"), "energy"))
    return sum((site["fn"].energy(site["value"]) for site in sites), jnp.zeros(()))
