"""Write the report of a finished run again, and write one page that compares several runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bayesreg.io.run_folder import RunFolder
from bayesreg.results.result import REPORT, load_result
from bayesreg.types import InputError


def report(folder: str | Path) -> Path:
    """Write the report of a finished run again, and return its path."""
    from bayesreg.report.html import write_report

    run_folder = RunFolder(Path(folder))
    # `locked` creates a missing folder; the check before it prevents this.
    run_folder.require_finished()
    with run_folder.locked():
        result = load_result(folder)
        with run_folder.writing() as temporary_path:
            write_report(result.run, result.idata, *result.convergence, temporary_path(REPORT))
    return result.report


def compare(folders: Sequence[str | Path], out: str | Path) -> Path:
    """Write one page that compares runs, and return its path."""
    from bayesreg.report.compare import write_comparison

    if not Path(out).absolute().parent.is_dir():
        raise InputError(f"{out} cannot be written: there is no folder {Path(out).parent}")
    results = [load_result(folder) for folder in folders]
    write_comparison([(r.run, r.idata, *r.convergence) for r in results], out)
    return Path(out)
