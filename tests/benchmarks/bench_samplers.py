"""One draw of every sampler on the paper's problem, with the chains of a run of `hmc` where they stand at its end.

    BAYESREG_RUN=DIR make bench ARGS="-k draw"

DIR is the folder of a run of `configs/converged_tissues.yaml` that has ended; without it there is nothing to time. All
samplers but the paper's are given its reference, walls and steps, so that there is no search and no warm-up. `smc`
draws as `hmc` does, once it has tempered.
"""

import os
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest

import bayesreg as br
from bayesreg.assembly import posterior_of
from bayesreg.inference.checkpoint import Checkpoint
from bayesreg.inference.run import checkpoint_from_arrays
from bayesreg.inference.samplers import SAMPLERS, chosen_sampler
from bayesreg.io import store
from bayesreg.model.posterior import Posterior

ROUNDS, DRAWS = 5, 3


class Finished(NamedTuple):
    """A posterior, and the chains at the end of a run."""

    posterior: Posterior
    end: Checkpoint
    places: dict[str, jax.Array]


@pytest.fixture(scope="module")
def finished() -> Finished:
    folder = os.environ.get("BAYESREG_RUN")
    if folder is None:
        pytest.skip("BAYESREG_RUN names no run that has ended")
    config = br.load_config(Path(folder) / "config.yaml")
    posterior, options = posterior_of(config, store.read_inputs(folder)), config.sampler
    arrays = store.load_state(folder)
    assert arrays is not None
    assert options.name == "hmc"
    arrays.pop("blocks")
    end = checkpoint_from_arrays(arrays, posterior, options.name, options.chains, **options.settings)
    draws = br.load_result(folder).idata.posterior.isel(draw=-1)
    known = posterior.reference()
    values = {name: jnp.asarray(draws[name].values, float) for name in known if name in draws}
    return Finished(posterior, end, jax.vmap(lambda each: posterior.estimands(known | each))(values))


@pytest.mark.parametrize("name", [name for name in SAMPLERS if name != "smc"])
def bench_draw(name: str, finished: Finished, timed: Any) -> None:
    posterior, end, places = finished
    sampler = chosen_sampler(name, posterior, {}).sampler
    setup = jax.tree.map(lambda x: x.mean(axis=0), places) if name == "rwmh" else end.setup
    data = sampler.data(setup)
    states = jax.jit(jax.vmap(sampler.init, in_axes=(None, None, 0)))(data, setup, places)
    chains = len(places["u_boundary"])

    @jax.jit
    def walk(data: Any, setup: Any, states: Any, keys: jax.Array) -> Any:
        return jax.lax.scan(
            lambda states, keys: jax.vmap(partial(sampler.step, data, setup))(keys, states), states, keys
        )

    arguments = data, setup, states, jax.random.split(jax.random.key(0), (DRAWS, chains))
    gradients, densities = (float(getattr(walk(*arguments)[1], kind).mean()) for kind in ("gradients", "densities"))
    told = {"sampler": name, "chains": chains, "draws": DRAWS, "gradients": gradients, "densities": densities}
    timed(walk, *arguments, rounds=ROUNDS, nodes=len(posterior.mesh.points), mesh="paper", **told)
