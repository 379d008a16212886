"""Kill a run at random moments, resume it, and compare what it leaves with a run that was left alone.

    python -m studies.endurance.kill -o DIR [--times 50] [--signal KILL|TERM|INT] [--meshing]

The moments are uniform over the time that a run takes from its first import to its report. Its status is 1 where a run
does not come to the same draws, bit for bit; with --meshing, where every run makes a mesh of its own, where it does not
come to a whole run.
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
    """Every variable of posterior.nc as it is stored."""
    with netCDF4.Dataset(path) as file:
        file.set_auto_mask(False)
        return {
            f"{group}/{name}": np.asarray(values[:]).tobytes() if values.dtype is not str else repr(values[:]).encode()
            for group, content in file.groups.items()
            for name, values in content.variables.items()
        }


def is_whole(out: Path) -> bool:
    """Whether a folder holds a finished run, as it was written, with as many draws as were asked for."""
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
    given = parser.parse_args()
    number, rng = signal.Signals[f"SIG{given.signal}"], np.random.default_rng(given.seed)
    config = write_pair(given.out)
    if given.meshing:
        settings = YAML(typ="safe").load(config)
        YAML(typ="safe").dump(settings | {"mesh": {"edge_length": 18.0}}, config)
    alone = given.out / "alone"
    # The first fills the cache of compiled programs.
    for _ in range(2):
        shutil.rmtree(alone, ignore_errors=True)
        began = time.monotonic()
        status, said = finish("run", config, "-o", alone, "-q")
        whole = time.monotonic() - began
        assert status in (0, 3), said
    expected, failures = contents(alone / "posterior.nc"), 0
    for moment in rng.uniform(0, whole, given.times):
        out = given.out / "killed"
        shutil.rmtree(out, ignore_errors=True)
        process = start("run", config, "-o", out, "-q")
        time.sleep(moment)
        process.send_signal(number)
        _, first = process.communicate()
        stage = RunFolder(out).stage
        blocks = len(list(out.glob("draws/*.npz")))
        again, second = finish("run", config, "-o", out, "-q", "--resume")
        same = (out / "posterior.nc").exists() and contents(out / "posterior.nc") == expected
        right = is_whole(out) if given.meshing else same
        left = [path.name for path in out.rglob(".partial-*")]
        report = (out / "report.html").exists()
        # A signal is obeyed, but for one that comes at the end.
        obeyed = process.returncode != 0 or moment > 0.8 * whole
        good = right and obeyed and report and not left and again in (0, 3) and "Traceback" not in first + second
        failures += not good
        print(
            f"{moment:5.1f} of {whole:.1f} s, status {process.returncode}, stage {stage}, {blocks} blocks; "
            f"resumed with status {again}: {'same' if same else 'other'} bits{'' if good else ' FAILED'}",
            flush=True,
        )
        if not good:
            print(first, second, left, sep="\n")
    print(f"{given.times - failures} of {given.times} came to {'a whole run' if given.meshing else 'the same bits'}")
    return int(failures > 0)


if __name__ == "__main__":
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", ".jax_cache")
    sys.exit(main())
