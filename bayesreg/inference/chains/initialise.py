"""Start values: overdispersed chains between identity and a given displacement."""

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
    """Where chains begin.

    Attributes
    ----------
    field : (b, 3) array, optional
        Displacement of the sampled nodes, mm, at the far end; None is no displacement.
    fraction : (float, float)
        Chains start at fractions of the field spread evenly over this range: 0 identity, 1 the field. A node
        that this would put behind a hard wall starts at the nearest fraction that does not.
    lam, mu : mapping of entry name to float, optional
        Centre of the start parameters, where it is not the posterior's own reference.
    spread : float
        Standard deviation of the log of the start parameters between chains.
    """

    field: Float[AnyArray, "boundary 3"] | None = None
    fraction: tuple[float, float] = (0.0, 1.0)
    lam: Mapping[str, float] | None = None
    mu: Mapping[str, float] | None = None
    spread: float = 0.1


def starting_points(target: Target, start: Start, chains: int, key: AnyArray) -> dict[str, AnyArray]:
    """Estimands of every chain (leading axis).

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
    """A fraction of the field; a node that it would put behind a hard wall takes the nearest fraction that does not.

    Both ends of a node's path may be allowed and its middle not: a skull is not convex. At zero the node is at
    rest, where it is allowed.
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


def _with_entries(values: AnyArray, given: Mapping[str, float] | None, target: Target, name: str) -> AnyArray:
    values, names = np.array(values), list(target.variables.coords["tissue"])
    for entry, value in (given or {}).items():
        if entry not in names:
            raise InputError(f"start.{name} names {entry!r}; the entries are {', '.join(names[:8])}")
        values[names.index(entry)] = value
    return values


def require_numbers(points: Estimands) -> None:
    """Raise InputError where a chain (leading axis) would start at what is not a finite number."""
    for name, values in points.items():
        for chain, value in enumerate(np.asarray(values)):
            if not np.isfinite(value).all():
                raise InputError(f"chain {chain} cannot start: {name} is not a number there; give another start")


def require_density(found: Evaluation) -> None:
    """Raise InputError where a chain (leading axis) would start with density zero."""
    for chain in np.flatnonzero(~np.isfinite(found.logdensity)):
        why = "a node lies in the skull, or a parameter outside its prior's range or without end"
        if not found.outside_support[chain]:
            why = "the elastic solve failed" if found.solver_failed[chain] else "it is not a number"
        raise InputError(
            f"chain {chain} cannot start: its density is zero because {why}; "
            "give another start field or fraction, or other start parameters"
        )
