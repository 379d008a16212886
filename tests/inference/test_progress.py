"""What the progress bar says of the time left, and ArviZ's announcement, which nobody needs to see."""

import os
import subprocess
import sys

import numpy as np
import pytest

from bayesreg.inference.chains.progress import draws_until, time_left


def test_draws_until_convergence_follow_the_excess_of_rhat():
    history = [(draws, 1 + 4.0 / draws) for draws in (100, 200, 300)]
    assert draws_until(history, 1.01) == pytest.approx(400)
    assert draws_until(history, None) is None
    assert draws_until([(100, np.inf), (200, np.nan)], 1.01) is None
    # One lucky look does not move it.
    assert draws_until([*history, (400, 1.0001)], 1.01) == pytest.approx(400)


def test_time_left_is_that_to_convergence_or_of_the_budget():
    assert time_left(300.0, 72.0) == "about 1.2 min left"
    assert time_left(300.0, None) == "at most 5.0 min left"
    assert time_left(300.0, 900.0) == "at most 5.0 min left"
    # R̂ is low enough, and something else is not.
    assert time_left(60.0, -1.0) == "at most 1.0 min left"
    assert time_left(-1.0, 5.0) == "at most 0.0 min left"


@pytest.mark.parametrize("cache", ["new", "a file/in its place"])
def test_arviz_is_imported_without_its_announcement(tmp_path, cache):
    """It makes the announcement once a day: with a new cache it has not been made yet, and one may not be writable."""
    (tmp_path / "a file").touch()
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / cache)}
    program = "from bayesreg.inference.draws.inference_data import arviz; arviz()"
    done = subprocess.run(
        [sys.executable, "-W", "always::FutureWarning", "-c", program],
        capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip
    assert "ArviZ is undergoing" not in done.stderr
