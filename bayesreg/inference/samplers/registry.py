"""The registry of samplers, all through BlackJAX: name to (target, settings…) → `Sampler`.

The paper's kernel moves in the constrained space of the estimands; the others in the coordinates in which Laplace's
approximation is N(0, I) (`bayesreg.inference.gaussian.whitened`), most of them reflected by the skull
(`bayesreg.inference.gaussian.reflection`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesreg.inference.kernel import Sampler
from bayesreg.inference.samplers.approximations import laplace_sampler, pathfinder
from bayesreg.inference.samplers.hamiltonian import hmc, mclmc, nuts
from bayesreg.inference.samplers.local import barker, mala, pcn, rwmh_adaptive
from bayesreg.inference.samplers.random_walk import rwmh
from bayesreg.inference.samplers.tempering import smc
from bayesreg.inference.target import Target
from bayesreg.types import InputError

SAMPLERS: dict[str, Callable[..., Sampler]] = {
    "rwmh": rwmh,
    "hmc": hmc,
    "nuts": nuts,
    "mclmc": mclmc,
    "mala": mala,
    "barker": barker,
    "rwmh_adaptive": rwmh_adaptive,
    "pcn": pcn,
    "smc": smc,
    "laplace": laplace_sampler,
    "pathfinder": pathfinder,
}


@dataclass(frozen=True)
class Chosen:
    """A sampler of the registry, made for a target.

    Two are equal if name, target and settings are: what is compiled for one serves the other, such as a second run with
    another seed, or for another pair of images on the same mesh.

    Raises
    ------
    InputError
        If a setting is out of range, or the target is not for this sampler.
    """

    name: str
    target: Target = field(repr=False)
    settings: tuple[tuple[str, Any], ...]
    sampler: Sampler = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sampler", SAMPLERS[self.name](self.target, **dict(self.settings)))


def chosen_sampler(name: str, target: Target, settings: dict[str, Any]) -> Chosen:
    """The sampler of that name, with these settings: numbers and words.

    Raises
    ------
    InputError
        If a setting is neither, or see `Chosen`.
    """
    plain = {
        key: value.item() if hasattr(value, "item") and np.size(value) == 1 else value
        for key, value in settings.items()
    }
    for key, value in plain.items():
        if not isinstance(value, (bool, int, float, str)):
            raise InputError(f"{key} must be a number or a word, got {value!r}")
    return Chosen(name, target, tuple(sorted(plain.items())))
