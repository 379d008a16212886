"""The posterior through UM-Bridge's own client, against the posterior itself."""

from __future__ import annotations

import socket
import time

import jax
import numpy as np
import pytest
import umbridge
from jax.flatten_util import ravel_pytree

import bayesreg as br
from bayesreg.inference.layout import slices
from bayesreg.workflow import serve
from studies.endurance.small_run import start as start_program
from studies.endurance.small_run import write_pair


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return write_pair(tmp_path_factory.mktemp("pair"))


@pytest.fixture(scope="module")
def posterior(config):
    return serve.posterior_of_run(config)


@pytest.fixture(scope="module")
def address(config):
    """Where the program serves it, on loopback alone."""
    with socket.socket() as free:
        free.bind((serve.LOOPBACK, 0))
        port = free.getsockname()[1]
    program = start_program("serve", config, "--port", str(port))
    try:
        while not _answers(port):
            assert program.poll() is None, program.stderr.read()
            time.sleep(0.2)
        yield f"http://{serve.LOOPBACK}:{port}"
    finally:
        program.terminate()
        program.communicate()


def _answers(port):
    with socket.socket() as trial:
        return trial.connect_ex((serve.LOOPBACK, port)) == 0


@pytest.mark.long
def test_the_client_finds_value_gradient_and_forward_model(posterior, address):
    assert umbridge.supported_models(address) == ["log_posterior", "forward", "start"]
    log_posterior, forward, start = (
        umbridge.HTTPModel(address, name) for name in ("log_posterior", "forward", "start")
    )
    at_rest = start([])
    sizes = [block.stop - block.start for block in slices(posterior.target).values()]
    assert [len(block) for block in at_rest] == log_posterior.get_input_sizes() == sizes
    rng = np.random.default_rng(0)
    position = [(np.array(block) + 0.1 * rng.normal(size=len(block))).tolist() for block in at_rest]
    flat = np.concatenate(position)
    _, unravel = ravel_pytree(posterior.unconstrain(posterior.reference()))
    value, slope = jax.value_and_grad(lambda x: posterior.logdensity(unravel(x)))(flat)
    # The program compiles for speed of compilation, and rounds in another order.
    assert log_posterior(position)[0][0] == pytest.approx(float(value), rel=1e-8)
    for k, entries in enumerate(slices(posterior.target).values()):
        gradient = log_posterior.gradient(0, k, position, [2.0])
        np.testing.assert_allclose(gradient, 2 * np.asarray(slope)[entries], rtol=1e-6, atol=1e-8)
    u, predicted = forward(position)
    expected = posterior.evaluate(posterior.constrain(unravel(flat)))
    np.testing.assert_allclose(np.reshape(u, (-1, 3)), expected.u, atol=1e-9)
    np.testing.assert_allclose(predicted, posterior.images.predicted(expected.u), atol=1e-9)
    # By finite differences, through the client alone.
    which = list(slices(posterior.target)).index("u_boundary")
    sensitivity = rng.normal(size=len(u))
    pulled = forward.gradient(0, which, position, sensitivity.tolist())
    step = 1e-5 * rng.normal(size=len(position[which]))
    ahead, behind = (
        [*position[:which], (np.array(position[which]) + sign * step).tolist(), *position[which + 1 :]]
        for sign in (1, -1)
    )
    difference = sensitivity @ (np.array(forward(ahead)[0]) - np.array(forward(behind)[0])) / 2
    assert step @ np.array(pulled) == pytest.approx(difference, rel=1e-5)


@pytest.mark.long
def test_what_is_impossible_is_a_number(address):
    log_posterior, start = (umbridge.HTTPModel(address, name) for name in ("log_posterior", "start"))
    position = [np.full(len(block), 1e200).tolist() for block in start([])]
    assert log_posterior(position) == [[serve.IMPOSSIBLE]]


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(br.InputError, match="holds no run of bayesreg"):
        serve.serve(tmp_path)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e160])
def test_what_is_no_number_is_never_accepted(posterior, value):
    """A trajectory that diverges comes to such places."""
    log_posterior, forward, start = serve.models_of(posterior)
    position = start([])
    sound = log_posterior(position)[0][0]
    which = list(slices(posterior.target)).index("mu")
    position[which] = [value] * len(position[which])
    assert log_posterior(position)[0][0] == serve.IMPOSSIBLE < sound
    assert not np.any(log_posterior.gradient(0, which, position, [1.0]))
    with pytest.raises(br.InputError, match="forward is no finite number"):
        forward(position)
