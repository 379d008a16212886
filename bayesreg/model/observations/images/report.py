"""The report on a pair of images: the residual, and its posterior predictive checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from bayesreg.model.observations.images.discrepancies import DISCREPANCIES
from bayesreg.model.observations.images.similarity import SIMILARITIES
from bayesreg.model.observations.images.unsupported import BEYOND, LEAST_MISFIT, NOT_COMPARED, support_file
from bayesreg.model.observations.section import Arrays, ReportFigure, ReportTable
from bayesreg.printable import number
from bayesreg.tissues import colours_of, label_of

NAMES = {
    "sd": "sd of the residual",
    "greatest": "greatest |residual|",
    "neighbours": "correlation between neighbouring cells",
}
# A posterior predictive p-value outside this range is called extreme.
EXTREME = (0.025, 0.975)
BINS = 60
# A tissue with fewer quadrature points has no curve in the figure.
LEAST_POINTS = 50


class ExpectedNoise(NamedTuple):
    """The distribution of standardised residuals if the model holds: its name, density, and share beyond ±3."""

    name: str
    density: Callable[[np.ndarray], np.ndarray]
    beyond_three: float


def noise_of(similarity: Mapping[str, Any]) -> ExpectedNoise:
    """Return the noise of a similarity, given by its settings, in units of the scale √(T_s / 2w)."""
    name, distribution = SIMILARITIES[similarity["kind"]](**similarity).noise()
    return ExpectedNoise(name, distribution.pdf, float(2 * distribution.sf(3)))


def check_table(name: str, summary: Arrays) -> ReportTable:
    """Make the table of realised and replicated discrepancies, with posterior predictive p-values."""
    rows, size = [], int(np.prod(summary["observed"].shape[:2]))
    for k, discrepancy in enumerate(DISCREPANCIES):
        observed, replicated = summary["observed"][..., k], summary["replicated"][..., k]
        p = predictive_p(observed, replicated)
        rows.append([NAMES[discrepancy], _interval(observed), _interval(replicated), _p_text(p, size), _judge(p)])
    caption = (
        f"Residuals in units of the noise sd that T_s implies, over {size:,} draws: those of the images, and those of "
        "noise that follows the model (median and 90 % interval). p is how often the noise of the model shows at least "
        "as much as the images do: near 0 there is more in the residual than the model allows, near 1 less. "
        "Neighbouring cells share a face."
    )
    header = ["", "Images", "Model", "How often more", "Residual"]
    return ReportTable(f"Posterior predictive checks{pair_suffix(name)}", caption, header, rows)


def residual_figure(
    name: str, summary: Arrays, tissues: Sequence[str], similarity: Mapping[str, Any], residual: str
) -> ReportFigure:
    """Make the histogram of the residual at the posterior mean, and the figure of the discrepancies."""
    z, expected = summary["residual"], noise_of(similarity)
    beyond = f"{float((np.abs(z) > 3).mean()):.2%}".replace("%", " %")
    caption = (
        f"Left: the residual at the {len(z):,} quadrature points, each over the scale that T_s implies there, by "
        f"tissue, and the density that it should follow, {expected.name}; {beyond} lie beyond ±3 "
        f"({expected.beyond_three:.2%} if it does). Right: the discrepancies of the table below."
    )
    if residual:
        caption += f" The residual is {residual}."
    alt = f"Histograms of the residual; its sd is {float(z.std()):.3g}."
    draw = partial(_draw_residual, summary, tissues, expected)
    return ReportFigure(f"residual-{name}", f"The residual{pair_suffix(name)}", caption, alt, 2.6, draw)


def support_figure(name: str, summary: Arrays) -> ReportFigure:
    """Make the figure of the places that the images do not support; see `find_unsupported`."""
    unseen, misfits = float(summary["unseen"]), summary["regions"][1:]
    caption = (
        "The organ from three sides. Grey: the images support the displacement. Striped: they are not compared, for "
        f"they are ignored there or one of them ends ({unseen:.1%} of the organ). Red: regions of at least "
        f"{LEAST_MISFIT:g} ml where the residual has one sign ({misfits[:, 0].sum():.3g} ml in {len(misfits)}). "
        f"{support_file(name)} holds the map."
    )
    alt = f"{len(misfits)} regions of misfit; {unseen:.1%} of the organ is not compared."
    return ReportFigure(
        f"support-{name}",
        f"What the images support{pair_suffix(name)}",
        caption,
        alt,
        2.6,
        partial(_draw_support, summary),
    )


def pair_suffix(name: str) -> str:
    """Return the part of a title that names the pair; empty for the main pair."""
    return "" if name == "images" else f" of {name}"


def _draw_residual(summary: Arrays, tissues: Sequence[str], expected: ExpectedNoise, figure: Any, style: Any) -> None:
    count = len(DISCREPANCIES)
    first, *others = np.ravel(figure.subplots(1, 1 + count, width_ratios=[1.6] + [1.0] * count))
    z = np.asarray(summary["residual"], float)
    reach = float(np.clip(np.quantile(np.abs(z), 0.995) * 1.15, 4.5, None))
    edges = np.linspace(-reach, reach, BINS + 1)
    for index, (tissue, colour) in enumerate(zip(tissues, colours_of(tissues), strict=True)):
        residuals = z[summary["residual_tissue"] == index]
        if len(residuals) >= LEAST_POINTS:
            density = np.histogram(residuals, edges)[0] / len(residuals) / np.diff(edges)
            label = f"{style.literal(label_of(tissue))}, sd {residuals.std():.2g}"
            first.stairs(density, edges, color=colour, lw=1.3, label=label)
    x = np.linspace(-reach, reach, 300)
    first.fill_between(x, expected.density(x), color=style.FAINT, lw=0, label=expected.name, zorder=0)
    first.set(xlim=(-reach, reach), ylim=(0, None), yticks=[], xlabel="standardised residual at the mean")
    first.spines["left"].set_visible(False)
    first.legend(loc="upper left", handlelength=1.2)
    for k, axes in enumerate(others):
        _draw_discrepancy(
            axes, NAMES[DISCREPANCIES[k]], summary["observed"][..., k], summary["replicated"][..., k], style
        )
    others[0].legend(loc="upper left", bbox_to_anchor=(0, 1.04), ncols=2, handlelength=1.0, columnspacing=1.0)


def _draw_support(summary: Arrays, figure: Any, style: Any) -> None:
    support = np.asarray(summary["support"])
    affine = np.asarray(summary["support_affine"])
    places = [affine[k, 3] + affine[k, k] * np.arange(n) for k, n in enumerate(support.shape)]
    names = ("x", "y", "z")
    for axis, axes in enumerate(np.ravel(figure.subplots(1, 3))):
        across = [k for k in range(3) if k != axis]
        x, y = (places[k] for k in across)
        for mask, draw in (
            (support != BEYOND, partial(axes.contourf, colors=[style.FAINT])),
            (support == NOT_COMPARED, partial(axes.contourf, colors=["none"], hatches=["////"])),
            (support > NOT_COMPARED, partial(axes.contourf, colors=[style.ACCENT], alpha=0.8)),
        ):
            if mask.any():
                draw(x, y, mask.any(axis=axis).T.astype(float), levels=[0.5, 1.5])
        axes.set(aspect="equal", xlabel=f"{names[across[0]]}, mm", ylabel=f"{names[across[1]]}, mm")


def _draw_discrepancy(axes: Any, name: str, observed: np.ndarray, replicated: np.ndarray, style: Any) -> None:
    for values, colour, label in ((replicated, style.MUTED, "model"), (observed, style.ACCENT, "images")):
        low, high = values.min(), values.max()
        margin = max(0.02 * (high - low), 1e-3 * abs(high))
        density, edges = np.histogram(values, np.linspace(low - margin, high + margin, 25))
        axes.stairs(density / density.max(), edges, fill=True, color=colour, alpha=0.65, lw=0, label=label)
    axes.set(yticks=[], ylim=(0, 1.3), xlabel=name)
    text = _p_text(predictive_p(observed, replicated), observed.size)
    axes.set_title(text, fontsize=8, color=style.MUTED, loc="right")
    axes.spines["left"].set_visible(False)


def predictive_p(observed: np.ndarray, replicated: np.ndarray) -> float:
    """Compute the posterior predictive p-value: the share of draws whose replicated discrepancy is not smaller.

    Near 0, the discrepancy of the data is larger than the model predicts; near 1, it is smaller.

    Parameters
    ----------
    observed, replicated : arrays of one shape
        The discrepancy of the data and of a replication, for every draw.
    """
    return float(np.mean(replicated >= observed))


def _p_text(p: float, draws: int) -> str:
    """Format a p-value, or a bound if no draw or every draw exceeds."""
    return f"p < {1 / draws:.2g}" if p == 0 else f"p > {1 - 1 / draws:.3g}" if p == 1 else f"p = {p:.3f}"


def _interval(draws: np.ndarray) -> str:
    low, median, high = (float(x) for x in np.quantile(draws, (0.05, 0.5, 0.95)))
    return f"{number(median)} ({number(low)} to {number(high)})"


def _judge(p: float) -> str:
    return "too much" if p < EXTREME[0] else "too little" if p > EXTREME[1] else "as the model has it"
