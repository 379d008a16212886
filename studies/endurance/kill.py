"""Kill a run at random moments, resume it, and compare its draws with those of an undisturbed run.

    python -m studies.endurance.kill -o DIR [--times 50] [--signal KILL|TERM|INT] [--meshing]

The moments are uniform over the time that a run takes from its first import to its report. The program ends with status
1 if a resumed run does not have the same draws, bit for bit. With --meshing every run makes its own mesh, and the
program ends with status 1 if a resumed run is not complete.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import time
from pathlib import Path

import netCDF4
import numpy as np
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg.io.run_folder import RunFolder
from studies.endurance.small_run import finish, start, write_pair


def contents(path: Path) -> dict[str, bytes]:
    """Return the bytes of every variable of posterior.nc."""
    with netCDF4.Dataset(path) as file:
        file.set_auto_mask(False)
        return {
            f"{group}/{name}": np.asarray(values[:]).tobytes() if values.dtype is not str else repr(values[:]).encode()
            for group, content in file.groups.items()
            for name, values in content.variables.items()
        }


def is_complete(out: Path) -> bool:
    """Whether a folder holds an undamaged, finished run with all 120 draws."""
    try:
        result = br.load_result(out)
    except br.InputError:
        return False
    return result.idata.posterior.sizes["draw"] == 120 and bool(np.isfinite(result.u_mean).all())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--signal", choices=("KILL", "TERM", "INT"), default="KILL")
    parser.add_argument("--meshing", action="store_true", help="no mesh is stored")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    signal_number, rng = signal.Signals[f"SIG{arguments.signal}"], np.random.default_rng(arguments.seed)
    config = write_pair(arguments.out)
    if arguments.meshing:
        settings = YAML(typ="safe").load(config)
        YAML(typ="safe").dump(settings | {"mesh": {"edge_length": 18.0}}, config)
    alone = arguments.out / "alone"
    # The first run fills the cache of compiled programs; the second one is timed.
    for _ in range(2):
        shutil.rmtree(alone, ignore_errors=True)
        began = time.monotonic()
        status, error_output = finish("run", config, "-o", alone, "-q")
        duration = time.monotonic() - began
        assert status in (0, 3), error_output
    expected, failures = contents(alone / "posterior.nc"), 0
    for moment in rng.uniform(0, duration, arguments.times):
        out = arguments.out / "killed"
        shutil.rmtree(out, ignore_errors=True)
        process = start("run", config, "-o", out, "-q")
        time.sleep(moment)
        process.send_signal(signal_number)
        _, killed_output = process.communicate()
        stage = RunFolder(out).stage
        blocks = len(list(out.glob("draws/*.npz")))
        resumed_status, resumed_output = finish("run", config, "-o", out, "-q", "--resume")
        same = (out / "posterior.nc").exists() and contents(out / "posterior.nc") == expected
        complete = is_complete(out) if arguments.meshing else same
        partial_files = [path.name for path in out.rglob(".partial-*")]
        report = (out / "report.html").exists()
        # A run must obey a signal, unless the signal comes at its end.
        obeyed = process.returncode != 0 or moment > 0.8 * duration
        passed = (
            complete
            and obeyed
            and report
            and not partial_files
            and resumed_status in (0, 3)
            and "Traceback" not in killed_output + resumed_output
        )
        failures += not passed
        print(
            f"{moment:5.1f} of {duration:.1f} s, status {process.returncode}, stage {stage}, {blocks} blocks; "
            f"resumed with status {resumed_status}: {'same' if same else 'other'} bits{'' if passed else ' FAILED'}",
            flush=True,
        )
        if not passed:
            print(killed_output, resumed_output, partial_files, sep="\n")
    print(
        f"{arguments.times - failures} of {arguments.times} came to "
        f"{'a whole run' if arguments.meshing else 'the same bits'}"
    )
    return int(failures > 0)


if __name__ == "__main__":
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", ".jax_cache")
    sys.exit(main())
