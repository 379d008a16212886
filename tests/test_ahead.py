"""Work ahead in another thread, and programs that are compiled so."""

import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import bayesreg as br
from bayesreg.ahead import ahead
from bayesreg.model import evaluation
from tests.options import posterior_of
from tests.phantoms import box_mesh, smooth_image


def test_the_block_waits_for_the_work_and_its_result():
    begun = threading.Event()
    with ahead(map(begun.wait, [10, 10])) as done:
        assert not done.done()
        begun.set()
    assert done.result() is True


def test_the_result_raises_the_error_of_the_work():
    with ahead(1 / divisor for divisor in (1, 0)) as done:
        pass
    with pytest.raises(ZeroDivisionError):
        done.result()


def test_an_error_in_the_block_does_not_wait_and_leaves_out_what_has_not_begun():
    steps, gate, taken = range(3), threading.Event(), []

    def take(step):
        taken.append(step)
        gate.wait(60)

    with pytest.raises(KeyError), ahead(map(take, steps)) as done:
        raise KeyError
    assert not done.done()
    gate.set()
    done.result(60)
    assert taken == [0]


def test_the_command_line_does_not_wait_for_what_is_no_longer_needed():
    """A command that fails while another thread works has its status at once."""
    code = (
        "import time\n"
        "from bayesreg import cli\n"
        "from bayesreg.ahead import ahead\n"
        "def fail():\n"
        "    with ahead(map(time.sleep, [600])):\n"
        "        raise SystemExit(2)\n"
        "cli.app = fail\n"
        "cli.main()\n"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 2


def test_programs_that_were_compiled_ahead_are_not_compiled_again(caplog):
    """A difference of one type or shape would compile warm-up and draws twice, and show in nothing else."""
    mesh = box_mesh(2)
    posterior = posterior_of(*(smooth_image(mesh.points, seed=seed) for seed in (1, 2)), mesh)
    with jax.log_compiles():
        br.sample(posterior, "hmc", chains=2, draws=3, block=3, warm_up=4, progress=False)
    # These are messages of the main thread alone.
    compiled = [message for message in caplog.messages if message.startswith("Finished XLA compilation")]
    assert any("jit(_observe)" in message for message in compiled)
    assert not any(f"jit({name})" in message for message in compiled for name in ("_transition", "run_block"))


def test_two_threads_may_trace_the_program_at_a_time(monkeypatch):
    """NumPyro has one stack for all threads: without a lock, sites of one trace appear in the other."""

    mesh = box_mesh(2)
    problem = posterior_of(*(smooth_image(mesh.points, seed=seed) for seed in (1, 2)), mesh).data

    def slow_program(problem, _guess):
        time.sleep(0.1)
        numpyro.sample("x", dist.Normal(problem.terms["mean"], 1.0))
        time.sleep(0.1)

    monkeypatch.setattr(evaluation, "registration", slow_program)
    with ThreadPoolExecutor(max_workers=2) as pool:
        problems = [problem.with_term("mean", mean) for mean in (0.0, 2.0)]
        traces = list(pool.map(lambda problem: evaluation._trace(problem, {"x": jnp.zeros(())}), problems))
    assert [float(trace["x"]["fn"].loc) for _, trace in traces] == [0.0, 2.0]
    np.testing.assert_allclose(float(traces[0][0]) - float(traces[1][0]), 2.0)
