"""Signals end a run between two blocks, or at once where it is not sampling."""

import logging
import signal
import sys
import time

import pytest
from typer.testing import CliRunner

from bayesreg.cli import app
from bayesreg.workflow import interruption
from bayesreg.workflow.interruption import Interrupted, ending_at_once, ending_between_blocks


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_first_signal_waits_and_the_second_does_not(number, status, caplog):
    caplog.set_level(logging.INFO)
    before = signal.getsignal(number)
    with ending_between_blocks() as require_none:
        require_none()
        signal.raise_signal(number)
        assert len(caplog.messages) == 1
        with pytest.raises(Interrupted, match=number.name) as stopped:
            require_none()
        assert stopped.value.status == status
        with pytest.raises(Interrupted):
            signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(number) is before
    with pytest.raises(Interrupted), ending_at_once():
        signal.raise_signal(number)
    assert signal.getsignal(number) is before


def test_the_command_line_says_how_to_go_on(monkeypatch, tmp_path):
    monkeypatch.setattr("bayesreg.workflow.reports.report", lambda *_, **__: signal.raise_signal(signal.SIGTERM))
    result = CliRunner().invoke(app, ["report", str(tmp_path)])
    assert result.exit_code == 143
    assert result.stderr.startswith("bayesreg: stopped by SIGTERM; a run goes on")
    assert "--resume" in result.stderr


def test_a_signal_that_python_drops_comes_again(capsys, monkeypatch):
    """As in a callback of the garbage collector."""
    monkeypatch.setattr(interruption, "AGAIN", 0.05)

    class Dropping:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    def work():
        Dropping()
        while time.monotonic() < began + 20:
            time.sleep(0.01)

    hook, began = sys.unraisablehook, time.monotonic()
    with pytest.raises(Interrupted), ending_at_once():
        work()
    assert time.monotonic() < began + 10
    assert "Interrupted" not in capsys.readouterr().err
    assert sys.unraisablehook is hook
