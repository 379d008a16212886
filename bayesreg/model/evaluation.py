"""The program evaluated: its log density, the terms of it, and what is found on the way."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int
from numpyro.infer.util import log_density

from bayesreg.model.coordinates import FIELD, LAME
from bayesreg.model.program import RegistrationData, log_elastic_normaliser, registration
from bayesreg.types import AnyArray, Scalar


class Evaluation(NamedTuple):
    """The log density at one place, and what was found on the way.

    Attributes
    ----------
    logdensity : scalar
        log p(u, λ, μ | m) up to a constant; −∞ outside the support and where the solve failed.
    u : (n, 3) array
        Displacement of every node, mm.
    similarity_energy, strain_energy : scalars
        E_s and E_r; with "student_t" E_s is −T_s times the log of the likelihood without its normaliser.
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


@partial(jax.jit, static_argnames="similarity")
def evaluate(
    data: RegistrationData,
    values: dict[str, AnyArray],
    similarity: str,
    guess: Float[AnyArray, "nodes 3"] | None = None,
) -> Evaluation:
    """The density of values and what was found on the way; a guess of u saves iterations and costs the derivative."""
    total, trace = log_density(registration, (data, similarity, guess), {}, values)
    found = {name: trace[name]["value"] for name in Evaluation._fields if name != "logdensity"}
    # Any NaN is a failure too: −∞, never NaN, so that no sampler can move there.
    return Evaluation(logdensity=jnp.where(jnp.isnan(total), -jnp.inf, total), **found)


@partial(jax.jit, static_argnames="similarity")
def terms(data: RegistrationData, values: dict[str, AnyArray], similarity: str) -> dict[str, Scalar]:
    """Every term of the log density by name, and the energies behind them."""
    _, trace = log_density(registration, (data, similarity), {}, values)
    terms = {name: trace[name]["value"] for name in ("similarity_energy", "strain_energy")}
    for name in (name for name in trace if name.startswith("log_")):
        terms[name] = trace[name]["fn"].log_prob(trace[name]["value"])
    for name in (name for name in (*LAME, *data.scales, "field") if name in values):
        terms[f"log_prior_{name}"] = trace[name]["fn"].log_prob(values[name])
    return terms


@jax.jit
def log_normaliser(data: RegistrationData, values: dict[str, AnyArray]) -> Scalar:
    """½ log pdet S(λ, μ) − r/2 log(2π T_r); zero where the density is not normalised."""
    field = {name: values[name] for name in FIELD if name in values}
    t_elastic = values.get("t_elastic", data.t_elastic)
    return log_elastic_normaliser(data, values["lam"], values["mu"], t_elastic, **field)


@jax.jit
def residuals(data: RegistrationData, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "points"]:
    """f(x_q) − m(x_q + u(x_q))."""
    displacement = data.quadrature.interpolation(u)
    return data.fixed_values - data.moving(data.positions + displacement)
