"""Time one draw of every sampler on the paper's problem, from the last state of the chains of a run of `hmc`.

    BAYESREG_RUN=DIR make bench ARGS="-k draw"

DIR is the folder of a finished run of `configs/converged_tissues.yaml`; without it the benchmark is skipped. A block of
draws is timed, made as a run makes it. All samplers except for the paper's use the reference, walls and steps of the
run, so that they need no search and no warm-up. `smc` draws as `hmc` does after its tempering.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.chains.beginning import _first, checkpoint_from_arrays
from bayesreg.inference.chains.block import run_block
from bayesreg.inference.chains.checkpoint import Checkpoint
from bayesreg.inference.samplers.registry import SAMPLERS, Chosen, choose_sampler
from bayesreg.io import checkpoints, store
from bayesreg.io.run_folder import RunFolder
from bayesreg.model.posterior import Posterior
from bayesreg.workflow.assembly import posterior_of

ROUNDS, DRAWS = 5, 3
# A draw of the paper's kernel is one step, and few steps are in the support.
STEPS, PAPERS_THIN = 1_000, 10


class Finished(NamedTuple):
    """A posterior, and the chains at the end of a run."""

    posterior: Posterior
    end: Checkpoint
    places: dict[str, jax.Array]


@pytest.fixture(scope="module")
def finished() -> Finished:
    folder = os.environ.get("BAYESREG_RUN")
    if folder is None:
        pytest.skip("BAYESREG_RUN names no finished run")
    run_folder = RunFolder(Path(folder))
    config = br.load_config(run_folder.path / "config.yaml")
    posterior, options = posterior_of(config, store.read_inputs(run_folder)), config.sampler
    arrays = checkpoints.load_state(run_folder)
    assert options.name == "hmc"
    arrays.pop("blocks")
    end = checkpoint_from_arrays(arrays, posterior.target, options.name, options.chains, **options.settings)
    draws = br.load_result(folder).idata.posterior.isel(draw=-1)
    reference = posterior.reference()
    values = {name: jnp.asarray(draws[name].values, float) for name in reference if name in draws}
    return Finished(posterior, end, jax.vmap(lambda each: posterior.estimands(reference | each))(values))


def block_from(chosen: Chosen, setup: Any, places: dict[str, jax.Array], draws: int, thin: int) -> Callable[[], Any]:
    """Return a function that makes a block of draws, as a run does, from chains at these places."""
    data = chosen.sampler.data(setup)
    begun = _first(chosen, data, setup, places)
    numbers = np.arange(len(places["u_boundary"]))
    return lambda: run_block(chosen, draws, thin, None, data, 0, numbers, 0, *begun[1:5])


@pytest.mark.parametrize("name", [name for name in SAMPLERS if name != "smc"])
def bench_draw(name: str, finished: Finished, timed: Any) -> None:
    posterior, end, places = finished
    sampler = choose_sampler(name, posterior.target)
    setup = jax.tree.map(lambda x: x.mean(axis=0), places) if name == "rwmh" else end.setup
    count, thin = (STEPS, PAPERS_THIN) if name == "rwmh" else (DRAWS, 1)
    block = block_from(sampler, setup, places, count // thin, thin)
    tally = block()[2]
    gradients, densities = (float(getattr(tally, kind).mean()) / count for kind in ("gradients", "densities"))
    chains = len(places["u_boundary"])
    facts = {"sampler": name, "chains": chains, "draws": count, "gradients": gradients, "densities": densities}
    timed(block, rounds=ROUNDS, nodes=len(posterior.mesh.points), mesh="paper", **facts)
