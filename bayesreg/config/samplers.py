"""The samplers' sections of a configuration: their settings, and how many chains and draws there are."""

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
    """Every how many transitions a draw is kept."""
    block: Count | None = None
    """Kept draws between two looks at the stop rule; null is 100, and fewer where many quadrature points make steps
    slow."""

    @property
    def settings(self) -> dict[str, Any]:
        """The sampler's own settings."""
        return self.model_dump(exclude={"name", *_Chains.model_fields})


class RandomWalk(settings.RandomWalk, _Chains):
    """The kernel of the paper, random-walk Metropolis."""

    name: Literal["rwmh"]
    chains: Chains = 3
    thin: Count = 10
    """Every how many transitions a draw is kept."""


class Hmc(settings.Hmc, _Chains):
    """Hamiltonian Monte Carlo; the default."""

    name: Literal["hmc"] = "hmc"


class Nuts(settings.Nuts, _Chains):
    """The No-U-Turn sampler."""

    name: Literal["nuts"]


class Smc(settings.Smc, _Chains):
    """Sequential Monte Carlo."""

    name: Literal["smc"]


class Laplace(settings.Laplace, _Chains):
    """Laplace's approximation."""

    name: Literal["laplace"]


SamplerConfig = Hmc | Nuts | Smc | Laplace | RandomWalk


def sampler_section(name: str) -> SamplerConfig:
    """The section of a sampler by its name, with default settings."""
    return TypeAdapter(Annotated[SamplerConfig, Field(discriminator="name")]).validate_python({"name": name})


def name_hmc_where_unnamed(value: object) -> object:
    """A section without a name is one of hmc."""
    return {"name": "hmc", **value} if isinstance(value, dict) and "name" not in value else value
