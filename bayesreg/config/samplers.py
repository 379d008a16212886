"""The samplers' sections of a configuration: their settings, and the numbers of chains and draws."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, TypeAdapter

from bayesreg.inference.samplers import settings
from bayesreg.settings import Count

Chains = Annotated[int, Field(strict=True, ge=1, le=65_536)]


class _Chains(BaseModel):
    """The options that all samplers' sections share."""

    chains: Chains = 4
    thin: Count = 1
    """The number of transitions per kept draw."""
    block: Count | None = None
    """The number of kept draws between two checks of the stop rule; null is 100, or fewer if many quadrature points
    make steps slow."""

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of the sampler itself, without the options that all samplers share."""
        return self.model_dump(exclude={"name", *_Chains.model_fields})


class RandomWalk(settings.RandomWalk, _Chains):
    """Random-walk Metropolis, the sampler of the paper."""

    name: Literal["rwmh"]
    chains: Chains = 3
    thin: Count = 10
    """The number of transitions per kept draw."""


class Auto(settings.Settings, _Chains):
    """The default: gibbs with points and surfaces alone and one stiffness, else hmc."""

    name: Literal["auto"] = "auto"


class Hmc(settings.Hmc, _Chains):
    """Hamiltonian Monte Carlo about a mode, the default with images."""

    name: Literal["hmc"]


class Nuts(settings.Nuts, _Chains):
    """The No-U-Turn sampler (NUTS)."""

    name: Literal["nuts"]


class Gibbs(settings.Gibbs, _Chains):
    """The Gibbs sampler of pairs of points."""

    name: Literal["gibbs"]


class Smc(settings.Smc, _Chains):
    """The sequential Monte Carlo sampler."""

    name: Literal["smc"]


class Laplace(settings.Laplace, _Chains):
    """Laplace's approximation of the posterior."""

    name: Literal["laplace"]


SamplerConfig = Auto | Hmc | Gibbs | Nuts | Smc | Laplace | RandomWalk


def sampler_section(name: str) -> SamplerConfig:
    """Make the section of a sampler with default settings, from the sampler's name."""
    return TypeAdapter(Annotated[SamplerConfig, Field(discriminator="name")]).validate_python({"name": name})


def name_where_unnamed(value: object) -> object:
    """Add a name to a section without one: auto, or hmc if it has settings of that; a text is the name alone."""
    if isinstance(value, str):
        return {"name": value}
    if not isinstance(value, dict) or "name" in value:
        return value
    return {"name": "auto" if set(value) <= set(_Chains.model_fields) else "hmc", **value}
