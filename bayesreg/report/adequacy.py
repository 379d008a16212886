"""Does the model explain the images? The residual in units of its noise, and posterior predictive checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from scipy import stats

from bayesreg.inference.draws.predictive import predictive_p
from bayesreg.io.records import Fit, Predicted
from bayesreg.report import panels, style
from bayesreg.report.panels import View
from bayesreg.report.slices import Plane, sample
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import number, part
from bayesreg.tissues import colours_of, label_of

NAMES = {
    "sd": "sd of the residual",
    "greatest": "greatest |residual|",
    "neighbours": "correlation between neighbouring cells",
}
SHOWN_SD = 4.0
# Outside of these a posterior predictive p-value is called extreme.
EXTREME = (0.025, 0.975)
BINS = 60
LEAST_POINTS = 50


def check_table(predicted: Predicted) -> Table | None:
    """Realised against replicated discrepancies, with posterior predictive p-values; None without images."""
    fit = predicted.fit
    if fit is None:
        return None
    rows = []
    for k, name in enumerate(fit.discrepancies):
        observed, replicated = fit.observed[..., k], fit.replicated[..., k]
        p = predictive_p(observed, replicated)
        title = NAMES.get(str(name), str(name))
        rows.append([title, _interval(observed), _interval(replicated), _p_text(p, observed.size), _judge(p)])
    caption = (
        f"Residuals in units of the noise sd that T_s implies, over {_count(fit):,} draws: those of "
        "the images, and those of noise that follows the model (median and 90 % interval). p is how often the noise of "
        "the model shows at least as much as the images do: near 0 there is more in the residual than the model "
        "allows, near 1 less. Neighbouring cells share a face."
    )
    return Table(
        "Posterior predictive checks", caption, ["", "Images", "Model", "How often more", "Residual"], [("", rows)]
    )


def _count(fit: Fit) -> int:
    return int(np.prod(fit.observed.shape[:2]))


def _p_text(p: float, draws: int) -> str:
    """A p-value; a bound where no draw, or every draw, exceeds."""
    return f"p < {1 / draws:.2g}" if p == 0 else f"p > {1 - 1 / draws:.3g}" if p == 1 else f"p = {p:.3f}"


def _interval(draws: np.ndarray) -> str:
    low, median, high = np.quantile(draws, (0.05, 0.5, 0.95))
    return f"{number(float(median))} ({number(float(low))} to {number(float(high))})"


def _judge(p: float) -> str:
    return "too much" if p < EXTREME[0] else "too little" if p > EXTREME[1] else "as the model has it"


def residual(view: View) -> Drawing | None:
    """The residual at the posterior mean on three planes, its histogram, and the discrepancies; None without images."""
    run, sd = view.run, part(view.run.manifest, "implied_noise_sd")
    fit = run.predicted.fit if run.predicted else None
    if fit is None or not sd:
        return None
    planes = view.planes[::-1]
    widths = [float(np.ptp(plane.horizontal)) for plane in planes]
    height = max(np.ptp(plane.vertical) for plane in planes) * style.WIDTH / sum(widths)
    with style.look():
        figure = style.new_figure(0.93 * height + 2.6)
        parts = figure.subfigures(2, 1, height_ratios=[0.93 * height + 0.2, 2.4], squeeze=False)
        upper, lower = parts[:, 0]
        axes = np.ravel(upper.subplots(1, 3, width_ratios=widths))
        pictures = [_picture(view, plane) / sd for plane in planes]
        reach = max(SHOWN_SD, float(np.nanquantile(np.abs(np.concatenate([x.ravel() for x in pictures])), 0.95)))
        for panel, plane, picture in zip(axes, planes, pictures, strict=True):
            drawn = panels.field_panel(panel, picture, plane, Normalize(-reach, reach), style.SIGNED)
            panels.outline(panel, view, plane)
            panel.set_title(plane.title)
        label = f"(f − m(x + ū)) / {number(float(sd))}, the implied noise sd"
        panels.colourbar(upper, drawn, list(axes), label, extend="both")
        count = len(fit.discrepancies)
        below = np.ravel(lower.subplots(1, 1 + count, width_ratios=[1.6] + [1.0] * count))
        _histogram(below[0], view, fit)
        for k, panel in enumerate(below[1:]):
            _discrepancy(panel, fit, k)
        below[1].legend(loc="upper left", bbox_to_anchor=(0, 1.04), ncols=2, handlelength=1.0, columnspacing=1.0)
        uri = style.data_uri(figure)
    z, expected = np.asarray(fit.residual), noise_of(run.manifest)
    beyond = f"{float((np.abs(z) > 3).mean()):.2%}".replace("%", " %")
    caption = (
        "Top: residual at the posterior mean, in units of the noise sd that T_s stands for at a quadrature point of "
        f"average weight; where the model holds nearly all of it is pale. Below, left: the residual at the {len(z):,} "
        "quadrature points, each over the scale that T_s implies there, by tissue, and the density that it should "
        f"follow, {expected.name}; {beyond} lie beyond ±3 ({expected.beyond_three:.2%} if it does). "
        "Right: the three discrepancies of the table below." + explain_difference(run.manifest)
    )
    alt = f"Residual maps and histograms; sd of the standardised residual {number(float(z.std()))}."
    return Drawing("residual", "The residual", caption, alt, uri)


def explain_difference(manifest: Mapping[str, Any]) -> str:
    """A sentence about maps of f − m(x + ū) where the similarity compares something else; empty where it does not."""
    left = {
        "lncc": "what the best affine map of the intensities of m in each window leaves of f",
        "mi": "f less the mean of its intensities where m has the same one",
        "mind": "a descriptor of f less that of m, of what a place looks like beside its neighbours",
    }
    similarity = str(part(manifest, "model", "similarity"))
    if similarity not in left:
        return ""
    return (
        f" The similarity is {similarity}, for images of unlike contrast: maps of f − m(x + ū) do not show its "
        f"residual, which is {left[similarity]}."
    )


class ExpectedNoise(NamedTuple):
    """The distribution of standardised residuals where the model holds: its name, density, and share beyond ±3."""

    name: str
    density: Callable[[np.ndarray], np.ndarray]
    beyond_three: float


def noise_of(manifest: Mapping[str, Any]) -> ExpectedNoise:
    """The noise of a run's model, in units of the scale √(T_s / 2w)."""
    if part(manifest, "model", "similarity") == "student_t":
        nu = float(part(manifest, "model", "degrees_of_freedom"))
        return ExpectedNoise(f"Student’s t with ν = {nu:g}", stats.t(nu).pdf, float(2 * stats.t.sf(3, nu)))
    return ExpectedNoise("standard Normal", stats.norm.pdf, float(2 * stats.norm.sf(3)))


def _picture(view: View, plane: Plane) -> np.ndarray:
    """f − m(x + ū) on a plane, NaN outside the mesh."""
    points, fixed, warped = plane.points(), view.run.fixed, view.run.warped
    assert fixed is not None
    assert warped is not None
    difference = sample(fixed, points) - sample(warped, points)
    return np.where(view.slice(plane).inside, difference, np.nan)


def _histogram(axes: Axes, view: View, fit: Fit) -> None:
    names, z = view.run.mesh.names, np.asarray(fit.residual, float)
    reach = float(np.clip(np.quantile(np.abs(z), 0.995) * 1.15, 4.5, None))
    edges = np.linspace(-reach, reach, BINS + 1)
    for index, (name, colour) in enumerate(zip(names, colours_of(names), strict=True)):
        inside = z[np.asarray(fit.residual_tissue) == index]
        if len(inside) >= LEAST_POINTS:
            density = np.histogram(inside, edges)[0] / len(inside) / np.diff(edges)
            axes.stairs(
                density,
                edges,
                color=colour,
                lw=1.3,
                label=f"{style.literal(label_of(name))}, sd {number(inside.std(), 2)}",
            )
    x = np.linspace(-reach, reach, 300)
    expected = noise_of(view.run.manifest)
    axes.fill_between(x, expected.density(x), color=style.FAINT, lw=0, label=expected.name, zorder=0)
    axes.set(xlim=(-reach, reach), ylim=(0, None), yticks=[], xlabel="standardised residual at the mean")
    axes.spines["left"].set_visible(False)
    axes.legend(loc="upper left", handlelength=1.2)


def _discrepancy(axes: Axes, fit: Fit, k: int) -> None:
    observed, replicated = (np.ravel(values[..., k]) for values in (fit.observed, fit.replicated))
    for values, colour, label in ((replicated, style.MUTED, "model"), (observed, style.ACCENT, "images")):
        low, high = values.min(), values.max()
        margin = max(0.02 * (high - low), 1e-3 * abs(high))
        edges = np.linspace(low - margin, high + margin, 25)
        density = np.histogram(values, edges)[0]
        axes.stairs(density / density.max(), edges, fill=True, color=colour, alpha=0.65, lw=0, label=label)
    axes.set(yticks=[], ylim=(0, 1.3), xlabel=NAMES.get(str(fit.discrepancies[k])))
    place: dict[str, Any] = {"fontsize": 8, "color": style.MUTED, "loc": "right"}
    axes.set_title(_p_text(predictive_p(observed, replicated), observed.size), **place)
    axes.spines["left"].set_visible(False)
