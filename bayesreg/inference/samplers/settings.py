"""The settings of every sampler, one record each; the sections of a configuration are made from these records.

They have a file of their own because a configuration is read before slow imports such as JAX.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from bayesreg.settings import Count, Positive
from bayesreg.settings import Section as Settings

Share = Annotated[float, Field(strict=True, gt=0, lt=1)]


class RandomWalk(Settings):
    """Random-walk Metropolis with the three Normal kernels of the paper."""

    sigma_u: Positive = 0.008
    """Sd of a step of each sampled displacement, mm."""
    sigma_lam: Positive = 0.03
    """Sd of a step of each λ."""
    sigma_mu: Positive = 0.003
    """Sd of a step of each μ."""


class AboutMode(Settings):
    """Settings of all samplers about a mode; see docs/samplers.md."""

    mode_search: Literal["once", "per_chain"] = "once"
    """once: one search for a mode, from the mean of the chains' starts; per_chain: one search from the start of each
    chain, which costs more by the number of chains. If the modes differ, each chain starts about its own."""


class Laplace(AboutMode):
    """Draws from the Gaussian with the curvature at the mode, a fast approximation of the posterior."""


class Tuned(AboutMode):
    """Settings of all samplers whose step size is tuned."""

    warm_up: Count = 80
    """Transitions that tune the step size and are not kept."""
    target_acceptance: Share = 0.75
    """Acceptance towards which the step size is tuned."""


class Hmc(Tuned):
    """Hamiltonian Monte Carlo in coordinates whitened at the mode, with trajectories of a quarter turn."""


class Nuts(Tuned):
    """The No-U-Turn sampler in coordinates whitened at the mode."""

    target_acceptance: Share = 0.8
    """Acceptance towards which the step size is tuned."""


class Smc(Tuned):
    """Particles move from a broad Gaussian to the posterior; chains start at some of them and continue as with hmc."""

    particles: Count = 128
    """Number of particles, at least that of the chains. Many particles find several modes and weigh them."""
    spread: Annotated[float, Field(strict=True, ge=1)] = 2.0
    """The factor by which the first distribution is wider than Laplace's approximation."""


class Gibbs(Settings):
    """Gibbs sampling of points and surfaces alone with random loads: displacements are integrated out."""

    warm_up: Count = 80
    """Transitions that are not kept, from which the steps of stiffness and scales are tuned."""
