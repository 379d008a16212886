"""What bayesreg says while it works is a record of `logging`, shown where somebody wants it."""

import io
import logging

import pytest
import rich
from rich.console import Console
from rich.progress import Progress

from bayesreg.messages import from_level, show_messages

LOG = logging.getLogger("bayesreg.somewhere")


@pytest.fixture
def terminal(monkeypatch):
    """What is written on a terminal of 40 columns."""
    written = io.StringIO()
    monkeypatch.setattr(rich, "_console", Console(file=written, width=40, force_terminal=True))
    return written


def test_messages_are_shown_as_they_are_and_warnings_stand_out(terminal):
    text = "a long line with [brackets], 95 % and a number 1,234 is neither broken nor coloured"
    with show_messages(), show_messages():
        LOG.info(text)
        LOG.warning("%d draws are few", 3)
        LOG.debug("details")
    LOG.info("nobody hears this")
    assert terminal.getvalue().splitlines() == [text, "warning: 3 draws are few"]


def test_a_level_holds_within_its_block(terminal):
    with show_messages():
        with from_level(logging.WARNING):
            LOG.info("left out")
        LOG.info("shown")
    assert terminal.getvalue() == "shown\n"
    assert logging.getLogger("bayesreg").level == logging.NOTSET


def test_they_appear_above_a_progress_bar(terminal):
    with show_messages(), Progress(console=rich.get_console(), auto_refresh=False) as bar:
        bar.add_task("sampling", total=10)
        bar.refresh()
        LOG.info("a signal has come")
        bar.refresh()
    lines = terminal.getvalue().split("\n")
    assert any("a signal has come" in line for line in lines)
    assert "sampling" in lines[-2]
