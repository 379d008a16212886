"""Start points of the chains, overdispersed between no displacement and a given one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayesreg.inference.target import Estimands, Evaluation, Target
from bayesreg.types import AnyArray, InputError


class Start(NamedTuple):
    """The options for the start points of the chains.

    Attributes
    ----------
    field : (b, 3) array, optional
        Displacement of the sampled nodes, mm, at fraction 1; None is no displacement.
    fraction : (float, float)
        Chains start at fractions of the field, spread evenly over this range: 0 is no displacement, 1 is the field. A
        node that would lie behind a hard wall starts at the nearest fraction at which it does not.
    lam, mu : mapping of entry name to float, optional
        Centre of the start parameters; the default is the reference of the posterior.
    spread : float
        Standard deviation of the log of the start parameters between chains.
    """

    field: Float[AnyArray, "boundary 3"] | None = None
    fraction: tuple[float, float] = (0.0, 1.0)
    lam: Mapping[str, float] | None = None
    mu: Mapping[str, float] | None = None
    spread: float = 0.1


def starting_points(target: Target, start: Start, chains: int, key: AnyArray) -> dict[str, AnyArray]:
    """Compute the estimands at which every chain (leading axis) starts.

    Raises
    ------
    InputError
        If the field has the wrong shape or a parameter's name is unknown.
    """
    at_rest = target.coordinates.reference()
    field = np.zeros(at_rest["u_boundary"].shape) if start.field is None else np.asarray(start.field, float)
    if field.shape != at_rest["u_boundary"].shape:
        raise InputError(f"the start field must have shape {at_rest['u_boundary'].shape}, got {field.shape}")
    fractions = np.linspace(*start.fraction, chains) if chains > 1 else np.array([np.mean(start.fraction)])
    values = target.variables.values(at_rest)
    for name in {"lam", "mu"} & set(values):
        values[name] = _with_entries(values[name], getattr(start, name), target, name)
    centre = target.variables.estimands(values)
    points = {"u_boundary": jnp.stack([_admissible(target, field, fraction) for fraction in fractions])}
    for name, subkey in zip(("lam", "mu"), jax.random.split(key), strict=True):
        if name in centre:
            noise = jax.random.normal(subkey, (chains, *centre[name].shape))
            points[name] = centre[name] * jnp.exp(start.spread * noise)
    for index, name in enumerate(sorted(set(centre) - set(points))):
        noise = jax.random.normal(jax.random.fold_in(key, index), (chains, *jnp.shape(centre[name])))
        points[name] = centre[name] * jnp.exp(start.spread * noise)
    return points


def _admissible(target: Target, field: np.ndarray, fraction: float) -> AnyArray:
    """Scale the field by a fraction; a node behind a hard wall takes the nearest fraction at which it is allowed.

    A skull is not convex: both ends of a node's path may be allowed while its middle is not. At fraction zero the node
    is at rest, which is always allowed.
    """
    chosen = np.full(len(field), fraction)
    if target.hard_wall is None:
        return jnp.asarray(chosen[:, None] * field)
    for candidate in sorted(np.linspace(0, 1, 201), key=lambda candidate: abs(candidate - fraction)):
        forbidden = np.asarray(target.hard_wall(target.data, jnp.asarray(chosen[:, None] * field)))
        if not forbidden.any():
            break
        chosen[forbidden] = candidate
    return jnp.asarray(chosen[:, None] * field)


def _with_entries(values: AnyArray, start_values: Mapping[str, float] | None, target: Target, name: str) -> AnyArray:
    values, names = np.array(values), list(target.variables.coords["tissue"])
    for entry, value in (start_values or {}).items():
        if entry not in names:
            raise InputError(f"start.{name} names {entry!r}; the entries are {', '.join(names[:8])}")
        values[names.index(entry)] = value
    return values


def require_numbers(points: Estimands) -> None:
    """Raise InputError if a start point of a chain (leading axis) has an entry that is not finite."""
    for name, values in points.items():
        for chain, value in enumerate(np.asarray(values)):
            if not np.isfinite(value).all():
                raise InputError(f"chain {chain} cannot start: {name} is not a number there; give another start")


def require_density(evaluation: Evaluation) -> None:
    """Raise InputError if the density is zero at the start point of a chain (leading axis)."""
    for chain in np.flatnonzero(~np.isfinite(evaluation.logdensity)):
        why = "a node lies in the skull, or a parameter outside its prior's range or without end"
        if not evaluation.outside_support[chain]:
            why = "the elastic solve failed" if evaluation.solver_failed[chain] else "it is not a number"
        raise InputError(
            f"chain {chain} cannot start: its density is zero because {why}; "
            "give another start field or fraction, or other start parameters"
        )
