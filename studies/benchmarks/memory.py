"""Compare the peak memory of runs, including their report, with 1,000 and with 10,000 draws of each chain.

    python -m studies.benchmarks.memory CONFIG [--set KEY=VALUE …] [--draws 1000 10000]

Both runs have the same mesh (--set mesh.file=…) and four chains of the paper's sampler, and keep every step. The draws
of the longer run take 330 MB for a thousand estimands.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile

from bayesreg.cli import NOT_CONVERGED


def main() -> None:
    """Print a line for each run, and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--draws", type=int, nargs=2, default=[1_000, 10_000])
    options = parser.parse_args()
    peaks = [peak(options.config, options.overrides, draws) for draws in options.draws]
    for draws, bytes_ in zip(options.draws, peaks, strict=True):
        print(f"{draws} draws of each of four chains: {bytes_ / 2**30:.3f} GiB")
    print(f"{peaks[1] / peaks[0] - 1:+.1%}")


def peak(config: str, overrides: list[str], draws: int) -> int:
    """Measure the peak memory of a run in bytes."""
    # This rule is never met: the suspect estimands are judged after every block, and all estimands at the end.
    rule = ["stop.rhat=1000", "stop.ess=1e9", f"stop.max_steps={draws}", "stop.max_minutes=null"]
    settings = ["sampler.name=rwmh", "sampler.chains=4", "sampler.thin=1", *rule]
    options = [argument for override in [*overrides, *settings] for argument in ("--set", override)]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", "from bayesreg.cli import main; main()", "run", config, "-o", f"{folder}/run"]
        process = subprocess.Popen([*command, *options, "--quiet"])
        _, status, used = os.wait4(process.pid, 0)
    if (ended := os.waitstatus_to_exitcode(status)) != NOT_CONVERGED:
        sys.exit(f"the run ended with status {ended}")
    return 1024 * used.ru_maxrss


if __name__ == "__main__":
    main()
