"""Three sets of coordinates of one state: values, estimands and positions (see `bayesreg.Posterior`)."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from bayesreg.model.priors import RangeTransform
from bayesreg.model.program import LameParameter, RegistrationData, stiffness_factor
from bayesreg.types import AnyArray, Scalar

Values = Mapping[str, AnyArray]

LAME = ("lam", "mu")
FIELD = ("field_sd", "field")


def complete(data: RegistrationData, estimands: Values, free: Mapping[str, np.ndarray]) -> dict[str, AnyArray]:
    """Estimands to values: with the known entries of λ and μ."""
    values = {"u_boundary": estimands["u_boundary"]}
    for name in LAME:
        known = jnp.asarray(getattr(data, name).reference)
        values[name] = known.at[free[name]].set(estimands[name]) if len(free[name]) else known
    return values | whitened(data, estimands) | {name: estimands[name] for name in data.scales}


def whitened(data: RegistrationData, values: Values) -> dict[str, AnyArray]:
    """The field's components, where there is a field: the same in all coordinates."""
    return {} if data.field is None else {"field": jnp.asarray(values["field"], float)}


def transform(parameter: LameParameter, free: np.ndarray) -> RangeTransform:
    """The map from the real line to the sampled entries of λ or μ."""
    low, high, reference = (jnp.asarray(x)[free] for x in (parameter.low, parameter.high, parameter.reference))
    return RangeTransform(low, high, reference)


def to_estimands(
    data: RegistrationData, position: Values, free: Mapping[str, np.ndarray]
) -> tuple[dict[str, AnyArray], Scalar]:
    """A position to estimands, and the logarithm of the Jacobian."""
    estimands, log_jacobian = {"u_boundary": position["u_boundary"], **whitened(data, position)}, jnp.zeros(())
    for name in LAME:
        if len(free[name]):
            to_range = transform(getattr(data, name), free[name])
            estimands[name] = to_range(position[name])
            log_jacobian += to_range.log_abs_det_jacobian(position[name], estimands[name]).sum()
    for name in data.scales:
        estimands[name] = jnp.exp(position[name])
        log_jacobian += position[name]
    return estimands, log_jacobian


def least_curvature(data: RegistrationData, position: Values, free: Mapping[str, np.ndarray]) -> dict[str, AnyArray]:
    """Of minus the log density in every coordinate, where next to nothing is known: one of a Normal score or logarithm.

    Without an upper bound a score is scale · z²/2 far out, where its logarithm, which knows no scale, is what has one.
    """
    least = {name: jnp.ones_like(value) for name, value in position.items()}
    for name in (name for name in LAME if len(free[name])):
        to_range, z = transform(getattr(data, name), free[name]), position[name]
        x = to_range(z)
        growth = jnp.exp(to_range.log_abs_det_jacobian(z, x)) / (x - to_range.low)
        least[name] = jnp.where(jnp.isinf(to_range.high), jnp.minimum(growth, 1.0) ** 2, 1.0)
    return least


def lame_by_cell(data: RegistrationData, values: Values) -> list[np.ndarray]:
    """λ and μ of every cell, the field's factor included."""
    field = {name: values[name] for name in FIELD if name in values}
    factor = np.asarray(stiffness_factor(data, **field)) if field else 1.0
    return [factor * np.asarray(values[name])[np.asarray(data.cell_entry)] for name in LAME]
