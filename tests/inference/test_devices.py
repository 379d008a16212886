"""Chains on two devices draw what they draw on one. Devices are counted when JAX starts: in a process of its own."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayesreg.inference.chains.beginning import first_checkpoint
from bayesreg.inference.chains.block import run_block
from bayesreg.inference.chains.devices import devices_for, side_by_side
from bayesreg.inference.chains.run import sample
from bayesreg.inference.samplers.registry import choose_sampler
from tests.inference.gaussians import GaussianTarget
from tests.model.test_equality import posterior

CHAINS, DRAWS = 4, 12


def found(sampler):
    """What differs between two devices, one, two again, and two with chains in another order."""
    problem = GaussianTarget() if sampler == "hmc" else posterior()
    target = problem.target
    settings = {} if sampler == "rwmh" else {"warm_up": 5}
    chosen, begun = (
        choose_sampler(sampler, target, **settings),
        first_checkpoint(target, sampler, CHAINS, 0, **settings),
    )
    data = chosen.sampler.data(begun.setup)

    def draws(devices, order=(0, 1, 2, 3)):
        order = np.array(order)
        state, moments, tally = jax.tree.map(lambda x: x[order], (begun.state, begun.moments, begun.tally))
        block = run_block(chosen, DRAWS, 2, devices, data, 1, order, 0, DRAWS, begun.setup, state, moments, tally)
        jax.block_until_ready(block)
        displacements = block[-1]["u_boundary"]
        return len(displacements.sharding.device_set), np.asarray(displacements)[np.argsort(order)]

    two = devices_for(CHAINS)
    (count, on_two), (_, on_one), (_, again), (_, mixed) = (
        draws(two), draws(None), draws(two), draws(two, (0, 2, 1, 3))
    )  # fmt: skip
    return {
        "devices": count,
        "programs": programs(problem, sampler, settings),
        "spread": float(on_two.std()),
        "moved": float(abs(on_two[:, 1:] - on_two[:, :-1]).max()),
        "one": float(abs(on_two - on_one).max()),
        "again": float(abs(on_two - again).max()),
        "mixed": float(abs(on_two - mixed).max()),
    }


def programs(problem, sampler, settings):
    """Compiled for a run of two blocks."""
    before = run_block._cache_size()
    sample(problem, sampler, CHAINS, draws=8, block=4, progress=False, **settings)
    return run_block._cache_size() - before


@pytest.mark.long
@pytest.mark.parametrize("sampler", ["hmc", "rwmh"])
def test_the_same_draws_on_two_devices(sampler):
    """To rounding; and the same bits on as many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    script = f"import json; from tests.inference.test_devices import found; print(json.dumps(found({sampler!r})))"
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    differences = json.loads(done.stdout)
    assert differences["devices"] == 2
    assert differences["programs"] == 1
    assert differences["moved"] > 0
    assert differences["again"] == 0
    assert max(differences["one"], differences["mixed"]) < 1e-9 * differences["spread"]


@pytest.mark.parametrize(
    ("backend", "chains", "groups"),
    [*[("cpu", *case) for case in ((4, 1), (16, 1), (17, 1), (24, 2), (32, 2), (40, 4), (64, 4))], ("gpu", 64, 1)],
)
def test_many_chains_run_in_groups_on_a_processor_and_find_the_same(monkeypatch, backend, chains, groups):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    matrix, x = jax.random.normal(jax.random.key(0), (5, 5)), jax.random.normal(jax.random.key(1), (chains, 5))

    def chain(number, x):
        return number, jnp.tanh(matrix @ x)

    numbers = jnp.arange(chains)
    jaxpr = jax.make_jaxpr(side_by_side(chain, None))(numbers, x)
    scans = [each.params["length"] for each in jaxpr.eqns if each.primitive.name == "scan"]
    assert scans == ([] if groups == 1 else [groups])
    same, outputs = side_by_side(chain, None)(numbers, x)
    np.testing.assert_array_equal(same, numbers)
    np.testing.assert_allclose(outputs, jnp.tanh(x @ matrix.T), rtol=1e-12)


def test_chains_that_cannot_be_shared_stay_on_one_device(monkeypatch):
    device = jax.devices()[0]
    for devices, chains, expected in ((1, 4, None), (3, 4, 2), (4, 6, 3), (3, 5, None), (8, 4, 4)):
        monkeypatch.setattr(jax, "devices", lambda count=devices: [device] * count)
        shared = devices_for(chains)
        assert (None if shared is None else shared.size) == expected
