"""Format the results of `make bench` as tables for the docs, and draw a figure beside the file.

    python -m studies.benchmarks.table docs/benchmarks.json

The program ends with status 1 if the results do not meet the bounds of issue 4.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from bayesreg.report.style import FAINT, MUTED, look, new_figure

CHAINS = 1, 4, 16, 64
COLOURS = {1: "#6ba3cf", 4: "#3f7cb0", 16: "#22527f", 64: "#0d2440"}
PEER = "#a84a53"
DRAWN = "cubic"
DPI = 160
LEAST_GAIN, MOST_DENSITIES = 5.0, 2.5
# The least ratio of the heights of two labels.
APART = 1.5

# The facts of one benchmark, and its median time as "seconds".
Record = dict[str, Any]


def main() -> None:
    """Print the tables and write the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    path = parser.parse_args().report
    report = json.loads(path.read_text(encoding="utf-8"))
    records = [each["extra_info"] | {"seconds": each["stats"]["median"]} for each in report["benchmarks"]]
    measurements = [each for each in records if "part" in each and "peer" not in each]
    peers = [each for each in records if "peer" in each]
    ratios, hold = acceptance(records)
    print("\n\n".join(filter(None, (machine(report), evaluations(measurements, peers), draws(records), ratios))))
    figure(path.with_suffix(".png"), measurements, peers)
    sys.exit(not hold)


def machine(report: dict[str, Any]) -> str:
    """Describe the machine, the versions and the commit."""
    info, commit = report["machine_info"], report["commit_info"]
    changed = " with changes" if commit["dirty"] else ""
    return (
        f"{info['cpu']}, {info['cores']} cores; Python {info['python']}, JAX {info['jax']}, SciPy {info['scipy']}, "
        f"cholespy {info['cholespy']}; commit {(commit['id'] or 'unknown')[:7]}{changed}"
    )


def evaluations(measurements: Sequence[Record], peers: Sequence[Record]) -> str:
    """Make a row for each mesh, interpolation and operation: milliseconds of all chains, and the share of the floor."""
    rows: dict[tuple[Any, ...], dict[int, Record]] = {}
    for each in measurements:
        rows.setdefault((each["nodes"], each["interpolation"], each["part"]), {})[each["chains"]] = each
    lines = []
    for (nodes, interpolation, operation), by_chains in rows.items():
        most = by_chains[max(by_chains)]
        beside = best_peer([peer for peer in peers if same(peer, most)], by_chains)
        cells = [milliseconds(by_chains.get(chains)) for chains in CHAINS]
        memory = f"{most['temporaries_bytes'] / 2**30:.2f}"
        lines.append([f"{nodes:,}", interpolation, operation, *cells, f"{most['compiling']:.1f}", memory, beside])
    titles = "nodes", "image", "part", *(f"{chains}, ms" for chains in CHAINS), "compiling, s", "GiB", "best peer"
    return markdown(titles, lines)


def acceptance(records: Iterable[Record]) -> tuple[str, bool]:
    """Describe the ratios that issue 4 bounds at the paper's size, and tell whether they meet the bounds."""
    lines, hold = [], True
    for each in records:
        if "gain" in each:
            hold &= each["gain"] >= LEAST_GAIN and each["densities"] <= MOST_DENSITIES
            gains, densities = (f"{min(x):.1f} to {max(x):.1f}" for x in zip(*each["passes"], strict=True))
            lines.append(
                f"{each['interpolation']}, {each['chains']} chains: a density {each['gain']:.1f} times as fast as the "
                f"best peer (at least {LEAST_GAIN:g}; in single passes {gains}), a gradient {each['densities']:.2f} "
                f"densities (at most {MOST_DENSITIES:g}; {densities})"
            )
    return "\n".join(lines), hold


def same(first: Record, second: Record) -> bool:
    """Whether two records are of the same operation and problem."""
    return all(first[name] == second[name] for name in ("nodes", "interpolation", "part"))


def milliseconds(each: Record | None) -> str:
    """Format the milliseconds of all chains, with the share of the floor in parentheses."""
    if each is None:
        return ""
    share = f" ({each['floor'] / each['seconds']:.0%})" if "floor" in each else ""
    return f"{rounded(1e3 * each['seconds'])}{share}"


def rounded(value: float) -> str:
    """Format a value with about three digits."""
    return f"{value:,.0f}" if value >= 99.95 else f"{value:.1f}" if value >= 9.995 else f"{value:.2f}"


def best_peer(peers: Sequence[Record], by_chains: dict[int, Record]) -> str:
    """Name the fastest peer, and the ratio of its time for 16 chains in turn to bayesreg's."""
    if not peers or 16 not in by_chains:
        return ""
    best = min(peers, key=lambda peer: peer["seconds"])
    return f"{best['peer']}, {16 * best['seconds'] / by_chains[16]['seconds']:.1f}"


def draws(records: Iterable[Record]) -> str:
    """Make a row for each sampler: the time of a draw of all chains, and the evaluations per draw of one chain."""
    rows = [
        [
            each["sampler"],
            str(each["chains"]),
            rounded(1e3 * each["seconds"] / each["draws"]),
            *(f"{each[kind]:.1f}" if kind in each else "" for kind in ("gradients", "densities")),
        ]
        for each in records
        if "sampler" in each
    ]
    return markdown(("sampler", "chains", "a draw of all, ms", "gradients", "densities"), rows)


def markdown(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table; without rows the result is empty."""
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) if rows else ""


def figure(path: Path, measurements: Sequence[Record], peers: Sequence[Record]) -> None:
    """Draw the cost of a density and of a gradient of one chain against the number of nodes."""
    with look():
        drawn = new_figure(4.2, 9.0)
        for axis, operation in zip(
            drawn.subplots(1, 2, sharex=True, sharey=True), ("density", "gradient"), strict=True
        ):
            chosen = [each for each in measurements if each["interpolation"] == DRAWN and each["part"] == operation]
            beside = [each for each in peers if each["interpolation"] == DRAWN and each["part"] == operation]
            panel(axis, chosen, beside)
            axis.set_title(f"One {operation} of one chain, ms")
        drawn.savefig(path, dpi=DPI)


def panel(axis: Axes, measurements: Sequence[Record], peers: Sequence[Record]) -> None:
    """Draw a labelled line for each number of chains, the peers, and a line proportional to the nodes."""
    axis.set(xscale="log", yscale="log", xlabel="nodes", xlim=(220, 150_000))
    axis.grid(color=FAINT, linewidth=0.5, alpha=0.6)
    for each in (axis.xaxis, axis.yaxis):
        each.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.12g}"))
    curves = {chains: curve([each for each in measurements if each["chains"] == chains]) for chains in CHAINS}
    curves = {chains: line for chains, line in curves.items() if len(line[0])}
    for chains, (x, y) in curves.items():
        axis.plot(x, y, "o-", color=COLOURS[chains], linewidth=1.8, markersize=4)
    begins = {chains: (x[0], y[0]) for chains, (x, y) in curves.items()}
    for chains, place in spread(begins).items():
        name = "1 chain" if chains == 1 else f"{chains} chains"
        named(axis, name, place, COLOURS[chains], (-8, 0), ha="right")
    for name in sorted({peer["peer"] for peer in peers}):
        x, y = curve([peer for peer in peers if peer["peer"] == name])
        axis.plot(x, y, "D--", color=PEER, linewidth=1.0, markersize=4)
        slower = y[0] >= max(1e3 * peer["seconds"] for peer in peers if peer["nodes"] == x[0])
        named(axis, name, (x[0], y[0]), PEER, (-8, 6 if slower else -6), ha="right")
    if curves:
        least = min(1e3 * each["seconds"] / each["chains"] / each["nodes"] for each in measurements)
        x = np.array([5_000.0, 100_000.0])
        axis.plot(x, 0.5 * least * x, ":", color=MUTED, linewidth=1.2)
        named(axis, "as the nodes", (x[0], 0.5 * least * x[0]), MUTED, (12, -6))


def named(
    axis: Axes,
    name: str,
    place: tuple[float, float],
    colour: str,
    points_away: tuple[float, float],
    ha: Literal["left", "right"] = "left",
) -> None:
    """Write text beside a place."""
    axis.annotate(name, place, points_away, textcoords="offset points", color=colour, fontsize=9, ha=ha, va="center")


def curve(records: Sequence[Record]) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of nodes, and the milliseconds of one chain."""
    points = sorted((each["nodes"], 1e3 * each["seconds"] / each["chains"]) for each in records)
    x, y = np.array(points, float).reshape(-1, 2).T
    return x, y


def spread(places: dict[int, tuple[float, float]]) -> dict[int, tuple[float, float]]:
    """Move labels of lines that begin at the same number of nodes up until they do not overlap."""
    records: dict[int, tuple[float, float]] = {}
    for chains, (x, y) in sorted(places.items(), key=lambda item: item[1]):
        below = [height for nodes, height in records.values() if nodes == x]
        records[chains] = (x, max([y, *(APART * height for height in below)]))
    return records


if __name__ == "__main__":
    main()
