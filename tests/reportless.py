"""Runs without their reports, whose pictures take longer than small runs do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def without_reports() -> Iterator[None]:
    """Within this block a run writes all its files but the report."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bayesreg.report.html.write_report", lambda *arguments: None)
        yield
