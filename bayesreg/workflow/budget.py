"""The budget of a run: its time, the memory of the machine, and the length of its blocks of draws."""

from __future__ import annotations

import numpy as np

from bayesreg.config import Config
from bayesreg.memory import memory_of_machine
from bayesreg.model.posterior import Posterior
from bayesreg.types import InputError

# BLOCK is the number of draws between two checks of the stop rule, for up to POINTS quadrature points. More points give
# smaller blocks, of at least FEWEST draws, because each block writes the whole state.
BLOCK, POINTS, FEWEST = 100, 20_000, 10
# The number of draws per block where each takes a part of a second.
COSTLY_DRAWS = 25


def max_seconds(config: Config) -> float | None:
    """Return the greatest time of search, warm-up and sampling, s."""
    return config.stop.max_minutes and 60 * config.stop.max_minutes


def require_memory(config: Config, posterior: Posterior) -> None:
    """Raise InputError if one block of draws and the moments of the chains exceed the memory of the machine."""
    options = config.sampler
    estimands = sum(np.size(value) for value in posterior.estimands(posterior.reference()).values())
    block = min(draws_per_block(config, posterior), config.stop.max_steps // options.thin)
    # Two moments per number; the new moments are made while the old ones still exist.
    needed = 8 * options.chains * (block * estimands + 4 * (estimands + posterior.mesh.points.size))
    if needed > (held := memory_of_machine()):
        raise InputError(
            f"sampler.chains = {options.chains:,} with blocks of {block:,} draws of {estimands:,} estimands need "
            f"{needed / 1e9:,.0f} GB, and this machine has {held / 1e9:,.0f} GB; give fewer chains, or fewer draws to "
            "a block (sampler.block)"
        )


def draws_per_block(config: Config, posterior: Posterior) -> int:
    """Return the number of draws per block of a configuration; without one, that of `block_length`."""
    return config.sampler.block or block_length(posterior)


def block_length(posterior: Posterior) -> int:
    """Choose the number of draws per block: costly steps get small blocks, so that time limits are checked in time.

    The number depends on the size of the problem and not on measured time, so that a seed always gives the same draws.
    """
    marginalisation = posterior.target.prepare_marginal
    if marginalisation is not None and marginalisation.has_costly_draws:
        return COSTLY_DRAWS
    points = sum(len(getattr(term, "positions", ())) for term in posterior.data.terms.values())
    return max(BLOCK * POINTS // max(points, POINTS), FEWEST)
