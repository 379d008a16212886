"""The registry of samplers: the settings and the maker of each name. All of them use BlackJAX.

The paper's kernel moves in the constrained space of the estimands. The other kernels move in the coordinates in which
Laplace's approximation is N(0, I) (`bayesreg.inference.gaussian.whitened`). A user can run any other BlackJAX kernel,
because the log density of a posterior is a function of a pytree (docs/samplers.md has an example).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pydantic import ValidationError

from bayesreg.inference.kernel import Sampler
from bayesreg.inference.samplers import settings
from bayesreg.inference.samplers.gibbs import gibbs
from bayesreg.inference.samplers.hamiltonian import hmc, nuts
from bayesreg.inference.samplers.laplace import laplace
from bayesreg.inference.samplers.random_walk import rwmh
from bayesreg.inference.samplers.settings import Settings
from bayesreg.inference.samplers.smc import smc
from bayesreg.inference.target import Target
from bayesreg.types import InputError


class Entry(NamedTuple):
    """A sampler of the registry: the class of its settings, and (target, settings) → `Sampler`."""

    settings: type[Settings]
    make: Callable[..., Sampler]


SAMPLERS: dict[str, Entry] = {
    "rwmh": Entry(settings.RandomWalk, rwmh),
    "hmc": Entry(settings.Hmc, hmc),
    "nuts": Entry(settings.Nuts, nuts),
    "gibbs": Entry(settings.Gibbs, gibbs),
    "smc": Entry(settings.Smc, smc),
    "laplace": Entry(settings.Laplace, laplace),
}


@dataclass(frozen=True)
class Chosen:
    """A sampler of the registry, made for a target.

    Two of them are equal if their names, targets and settings are equal. Code that is compiled for one then serves the
    other: a second run with another seed, or a run for another pair of images on the same mesh.

    Raises
    ------
    InputError
        If the sampler does not accept the target.
    """

    name: str
    target: Target = field(repr=False)
    settings: Settings
    sampler: Sampler = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sampler", SAMPLERS[self.name].make(self.target, self.settings))


# The name of the sampler that suits the target: gibbs if displacements are integrated out at a low cost, else hmc.
AUTO = "auto"


def choose_sampler(name: str, target: Target, **settings: Any) -> Chosen:
    """Make the named sampler for a target with these settings; the name may be `AUTO`.

    Raises
    ------
    InputError
        If there is no such sampler or setting, a setting is out of range, or the sampler does not accept the target.
    """
    if name == AUTO:
        marginalisation = target.prepare_marginal
        name = "hmc" if marginalisation is None or marginalisation.is_costly else "gibbs"
    if name not in SAMPLERS:
        raise InputError(f"unknown sampler {name!r}; there are {', '.join([AUTO, *SAMPLERS])}")
    record = SAMPLERS[name].settings
    plain = {key: value.item() if getattr(value, "size", 0) == 1 else value for key, value in settings.items()}
    try:
        return Chosen(name, target, record(**plain))
    except ValidationError as error:
        wrong = "; ".join(_explain(details, record) for details in error.errors(include_url=False))
        raise InputError(f"sampler {name}: {wrong}") from None


def _explain(details: Any, record: type[Settings]) -> str:
    """Turn one of pydantic's errors into a message."""
    key = ".".join(map(str, details["loc"]))
    if details["type"] == "extra_forbidden":
        return f"there is no setting {key}; there are {', '.join(record.model_fields) or 'none'}"
    return f"{key} = {details['input']!r}: {details['msg'].replace('Input should be', 'expected')}"
