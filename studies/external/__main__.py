"""`make peers`: compare bayesreg with Demons, B-splines and SyN, on pairs that none of them made.

    BAYESREG_DATA=… python -m studies.external [KIND:SEED:BIAS …] [-o OUT] [--runs DIR] [--peers-only]

By default the pairs are sag and gravity of `studies.external.make_pair`, seeds 11, 12 and 13 with a bias of 0, 0.15
and 0.25 respectively. bayesreg gets the files and the labels and no other option; `studies.external.peers` describes
the inputs of the peers. All methods are scored on the voxels of bayesreg's run. With --peers-only bayesreg does not
run, and the peers are scored wherever the truth is valid. The program prints two tables; their times are those of
whole programs, from files to files.

OUT, by default runs/peers, keeps all finished steps, and these are not repeated: OUT/sag-11-0/pair, /bayesreg, /Demons
and so on hold the files, and /times and /scores hold a JSON file of each method. --runs names a folder of finished runs
of bayesreg, DIR/sag-11-0 and so on.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from studies.external.make_pair import KINDS, Kind, data_folder, make_pair
from studies.external.peers import FIELD, PEERS, THREADS
from studies.external.score import TISSUES, score

BAYESREG = "bayesreg"
SD = "displacement_sd.nii.gz"
# Status 3 means that the run wrote its results but did not converge.
WRITTEN = (0, 3)


class PairRequest(NamedTuple):
    """The kind of a pair, its seed, and the strength of the shading of its moving image."""

    kind: Kind
    seed: int
    bias: float

    @classmethod
    def read(cls, text: str) -> PairRequest:
        """Parse a request from KIND:SEED:BIAS."""
        try:
            kind, seed, bias = text.split(":")
            request = cls(kind, int(seed), float(bias))
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text} is no KIND:SEED:BIAS such as sag:11:0.15") from error
        if kind not in KINDS:
            raise argparse.ArgumentTypeError(f"{kind} is none of {', '.join(KINDS)}")
        return request

    @property
    def name(self) -> str:
        """The name of the pair's folder."""
        return f"{self.kind}-{self.seed}-{self.bias:g}"


DEFAULT = [
    PairRequest(kind, seed, bias) for kind in ("sag", "gravity") for seed, bias in ((11, 0.0), (12, 0.15), (13, 0.25))
]


class Row(NamedTuple):
    """The results of one method on one pair."""

    pair: PairRequest
    method: str
    scores: dict[str, Any]
    times: dict[str, float | None]
    # None for a peer, and for a run that did not test its convergence.
    converged: bool | None


def timed(command: Sequence[str | Path], record: Path, statuses: Iterable[int] = (0,)) -> None:
    """Run a program, with ITK on THREADS threads, and write its elapsed and processor seconds."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    threads = {"ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS": str(THREADS)}
    done = subprocess.run(command, env=os.environ | threads, stdout=subprocess.DEVNULL, check=False)
    seconds, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in statuses:
        raise SystemExit(f"{' '.join(map(str, command))} ended with status {done.returncode}")
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    _write(record, {"seconds": seconds, "processor_seconds": processor})


def register(request: PairRequest, folder: Path, run: Path | None) -> list[Row]:
    """Run every method on one pair; run the peers alone if `run` is None."""
    pair = folder / "pair"
    if not (pair / "pair.json").exists():
        print(f"{request.name}: making the pair", file=sys.stderr, flush=True)
        make_pair(request.kind, data_folder(), pair, seed=request.seed, bias=request.bias)
    rows = []
    if run is not None:
        record = folder / "times" / f"{BAYESREG}.json"
        if not (run / SD).exists():
            print(f"{request.name}: {BAYESREG}", file=sys.stderr, flush=True)
            timed(
                [Path(sys.executable).parent / BAYESREG, "run", configure(pair), "-o", run, "--resume"], record, WRITTEN
            )
        manifest = json.loads((run / "run.json").read_text(encoding="utf-8"))
        elapsed = {"seconds": manifest["timings"]["total"], "processor_seconds": None}
        times = json.loads(record.read_text(encoding="utf-8")) if record.exists() else elapsed
        scores = scored(folder / "scores" / f"{BAYESREG}.json", pair, run / FIELD, run / SD, run)
        rows.append(Row(request, BAYESREG, scores, times, manifest["stopped"]["converged"]))
    for name in PEERS:
        field, record = folder / name / FIELD, folder / "times" / f"{name}.json"
        if not record.exists():
            print(f"{request.name}: {name}", file=sys.stderr, flush=True)
            timed([sys.executable, "-m", "studies.external.peers", name, pair, "-o", field.parent], record)
        scores = scored(folder / "scores" / f"{name}{'' if run else ' alone'}.json", pair, field, on=run)
        rows.append(Row(request, name, scores, json.loads(record.read_text(encoding="utf-8")), None))
    return rows


def configure(pair: Path) -> Path:
    """Write the configuration of a new user, with files and labels, as JSON, which is valid YAML."""
    files = {name: str(pair.resolve() / f"{name}.nii.gz") for name in ("fixed", "moving", "labels", "intracranial")}
    path = pair.parent / f"{BAYESREG}.yaml"
    _write(path, {"data": {"source": "files", **files, "label_table": TISSUES}})
    return path


def scored(record: Path, pair: Path, mean: Path, sd: Path | None = None, on: Path | None = None) -> dict[str, Any]:
    """The scores of a field, from `record` if that is newer than the files, else computed."""
    sources = [mean, pair / "pair.json", *([on / SD] if on else [])]
    if not record.exists() or record.stat().st_mtime < max(source.stat().st_mtime for source in sources):
        _write(record, score(pair, mean, sd, on))
    return json.loads(record.read_text(encoding="utf-8"))


def accuracy(rows: Iterable[Row]) -> str:
    """Make the table of errors in mm, shares of folded voxels, and minutes."""
    titles = "pair, its mean displacement", "method", "mean error, mm", "95 %", "greatest", "GM", "WM", "CSF", "folded"
    lines = [
        [
            f"{row.pair.kind}, seed {row.pair.seed}, bias {row.pair.bias:g}: {row.scores['unregistered_mean']:.2f} mm",
            row.method,
            *(f"{value:.3f}" for value in row.scores["error"]),
            *(f"{row.scores[tissue][0]:.2f}" for tissue in ("gm", "wm", "csf")),
            f"{row.scores['folded_share']:.2%}",
            minutes(row.times["seconds"]),
            minutes(row.times["processor_seconds"]),
        ]
        for row in rows
    ]
    return markdown([*titles, "time, min", "of one processor, min"], lines)


def uncertainty(rows: Iterable[Row]) -> str:
    """Make the table of the calibration of bayesreg's error estimates."""
    titles = "pair", "inside 50 / 90 / 95 %", "sd over rms error", "given", "converged"
    verdicts = {True: "yes", False: "no", None: "not asked"}
    lines = [
        [
            f"{row.pair.kind}, seed {row.pair.seed}",
            " / ".join(f"{share:.1%}" for share in row.scores["coverage_50_90_95"]),
            f"{row.scores['sd_over_rms_error']:.2f}",
            f"{row.scores['given_share']:.1%}",
            verdicts[row.converged],
        ]
        for row in rows
        if "coverage_50_90_95" in row.scores
    ]
    return markdown(titles, lines)


def minutes(seconds: float | None) -> str:
    """Format a time in minutes; an unknown time is empty."""
    return "" if seconds is None else f"{seconds / 60:.1f}"


def markdown(titles: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table; without lines the result is empty."""
    cells = [titles, ["---"] * len(titles), *lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells) if lines else ""


def _write(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Run the steps that are not finished, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="*", type=PairRequest.read, default=DEFAULT, metavar="KIND:SEED:BIAS")
    parser.add_argument("-o", "--out", type=Path, default=Path("runs/peers"))
    parser.add_argument("--runs", type=Path, help="folder of runs of bayesreg, named as the pairs are")
    parser.add_argument("--peers-only", action="store_true", help="no run of bayesreg")
    arguments = parser.parse_args()
    if any(not (arguments.out / request.name / "pair" / "pair.json").exists() for request in arguments.pairs):
        data_folder()
    rows = []
    for request in arguments.pairs:
        folder = arguments.out / request.name
        run = arguments.runs / request.name if arguments.runs else folder / BAYESREG
        rows += register(request, folder, None if arguments.peers_only else run)
    print("\n\n".join(filter(None, (accuracy(rows), uncertainty(rows)))))


if __name__ == "__main__":
    main()
