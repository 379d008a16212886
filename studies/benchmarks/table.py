"""What `make bench` has found, as tables for the docs and a figure beside the file.

    python -m studies.benchmarks.table docs/benchmarks.json

Ends with status 1 where the acceptance lines of issue 4 that it can tell do not hold.
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
# Labels of lines are kept apart by this factor.
APART = 1.5

# Of one benchmark: what it told, and its median as "seconds".
Found = dict[str, Any]


def main() -> None:
    """Print the tables and write the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    path = parser.parse_args().report
    report = json.loads(path.read_text(encoding="utf-8"))
    found = [each["extra_info"] | {"seconds": each["stats"]["median"]} for each in report["benchmarks"]]
    parts = [each for each in found if "part" in each and "peer" not in each]
    peers = [each for each in found if "peer" in each]
    ratios, hold = acceptance(found)
    print("\n\n".join(filter(None, (machine(report), evaluations(parts, peers), draws(found), ratios))))
    figure(path.with_suffix(".png"), parts, peers)
    sys.exit(not hold)


def machine(report: dict[str, Any]) -> str:
    """Where and of what."""
    info, commit = report["machine_info"], report["commit_info"]
    changed = " with changes" if commit["dirty"] else ""
    return (
        f"{info['cpu']}, {info['cores']} cores; Python {info['python']}, JAX {info['jax']}, SciPy {info['scipy']}, "
        f"cholespy {info['cholespy']}; commit {(commit['id'] or 'unknown')[:7]}{changed}"
    )


def evaluations(parts: Sequence[Found], peers: Sequence[Found]) -> str:
    """A row for each mesh, interpolation and part: milliseconds of all chains, and of their floor where it is known."""
    rows: dict[tuple[Any, ...], dict[int, Found]] = {}
    for each in parts:
        rows.setdefault((each["nodes"], each["interpolation"], each["part"]), {})[each["chains"]] = each
    lines = []
    for (nodes, interpolation, part), by_chains in rows.items():
        most = by_chains[max(by_chains)]
        beside = best_peer([peer for peer in peers if same(peer, most)], by_chains)
        cells = [milliseconds(by_chains.get(chains)) for chains in CHAINS]
        memory = f"{most['temporaries_bytes'] / 2**30:.2f}"
        lines.append([f"{nodes:,}", interpolation, part, *cells, f"{most['compiling']:.1f}", memory, beside])
    titles = "nodes", "image", "part", *(f"{chains}, ms" for chains in CHAINS), "compiling, s", "GiB", "best peer"
    return markdown(titles, lines)


def acceptance(found: Iterable[Found]) -> tuple[str, bool]:
    """What issue 4 asks at the paper's size, and whether it holds."""
    lines, hold = [], True
    for each in found:
        if "gain" in each:
            hold &= each["gain"] >= LEAST_GAIN and each["densities"] <= MOST_DENSITIES
            gains, densities = (f"{min(x):.1f} to {max(x):.1f}" for x in zip(*each["passes"], strict=True))
            lines.append(
                f"{each['interpolation']}, {each['chains']} chains: a density {each['gain']:.1f} times as fast as the "
                f"best peer (at least {LEAST_GAIN:g}; in single passes {gains}), a gradient {each['densities']:.2f} "
                f"densities (at most {MOST_DENSITIES:g}; {densities})"
            )
    return "\n".join(lines), hold


def same(one: Found, other: Found) -> bool:
    """Whether two are of one part of one problem."""
    return all(one[name] == other[name] for name in ("nodes", "interpolation", "part"))


def milliseconds(each: Found | None) -> str:
    """Of all chains; in parentheses the share that the floor is of it."""
    if each is None:
        return ""
    share = f" ({each['floor'] / each['seconds']:.0%})" if "floor" in each else ""
    return f"{rounded(1e3 * each['seconds'])}{share}"


def rounded(value: float) -> str:
    """To three digits or so."""
    return f"{value:,.0f}" if value >= 99.95 else f"{value:.1f}" if value >= 9.995 else f"{value:.2f}"


def best_peer(peers: Sequence[Found], by_chains: dict[int, Found]) -> str:
    """The fastest of the peers, and how many times as long it takes for 16 chains, one after the other."""
    if not peers or 16 not in by_chains:
        return ""
    best = min(peers, key=lambda peer: peer["seconds"])
    return f"{best['peer']}, {16 * best['seconds'] / by_chains[16]['seconds']:.1f}"


def draws(found: Iterable[Found]) -> str:
    """A row for each sampler: of all its chains together, and what a draw of one evaluates."""
    rows = [
        [
            each["sampler"],
            str(each["chains"]),
            rounded(1e3 * each["seconds"] / each["draws"]),
            *(f"{each[kind]:.1f}" if kind in each else "" for kind in ("gradients", "densities")),
        ]
        for each in found
        if "sampler" in each
    ]
    return markdown(("sampler", "chains", "a draw of all, ms", "gradients", "densities"), rows)


def markdown(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Nothing, if there are no rows."""
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) if rows else ""


def figure(path: Path, parts: Sequence[Found], peers: Sequence[Found]) -> None:
    """Cost of a density and of a gradient of a chain against nodes."""
    with look():
        drawn = new_figure(4.2, 9.0)
        for axis, part in zip(drawn.subplots(1, 2, sharex=True, sharey=True), ("density", "gradient"), strict=True):
            chosen = [each for each in parts if each["interpolation"] == DRAWN and each["part"] == part]
            beside = [each for each in peers if each["interpolation"] == DRAWN and each["part"] == part]
            panel(axis, chosen, beside)
            axis.set_title(f"One {part} of one chain, ms")
        drawn.savefig(path, dpi=DPI)


def panel(axis: Axes, parts: Sequence[Found], peers: Sequence[Found]) -> None:
    """A line for each number of chains, named where it begins; the peers; and how the nodes grow."""
    axis.set(xscale="log", yscale="log", xlabel="nodes", xlim=(220, 150_000))
    axis.grid(color=FAINT, linewidth=0.5, alpha=0.6)
    for each in (axis.xaxis, axis.yaxis):
        each.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.12g}"))
    curves = {chains: curve([each for each in parts if each["chains"] == chains]) for chains in CHAINS}
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
        least = min(1e3 * each["seconds"] / each["chains"] / each["nodes"] for each in parts)
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
    """Text beside a place."""
    axis.annotate(name, place, points_away, textcoords="offset points", color=colour, fontsize=9, ha=ha, va="center")


def curve(found: Sequence[Found]) -> tuple[np.ndarray, np.ndarray]:
    """Nodes, and milliseconds of a chain."""
    points = sorted((each["nodes"], 1e3 * each["seconds"] / each["chains"]) for each in found)
    x, y = np.array(points, float).reshape(-1, 2).T
    return x, y


def spread(places: dict[int, tuple[float, float]]) -> dict[int, tuple[float, float]]:
    """Places of labels: those of lines that begin at one number of nodes are moved up until they are apart."""
    found: dict[int, tuple[float, float]] = {}
    for chains, (x, y) in sorted(places.items(), key=lambda item: item[1]):
        below = [height for other, height in found.values() if other == x]
        found[chains] = (x, max([y, *(APART * height for height in below)]))
    return found


if __name__ == "__main__":
    main()
