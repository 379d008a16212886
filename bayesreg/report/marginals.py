"""Figures of marginal posteriors: stiffness ratios by tissue (Fig. 4) and one node at the skull (Fig. 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from scipy import stats

from bayesreg.distance import signed_distance
from bayesreg.image import Image
from bayesreg.io.records import Run, Truth
from bayesreg.report import panels, style
from bayesreg.report.estimands import SYMBOLS, Group, parameter_groups, sampled_scales, symbol_of
from bayesreg.report.slices import COORDINATES, IN_PLANE, Plane, sample
from bayesreg.report.style import Drawing
from bayesreg.report.verdict import number, part, place_text
from bayesreg.tissues import colours_of, label_of

BINS = 32
REACH = 6.0
LOG_SPAN = 20.0
FAR = 2.0
NEAR = 0.25
SEARCH_DRAWS = 240
SHOWN_DRAWS = 6000
CLOUD_DRAWS = 600
ZOOM = 13.0


def stiffness(run: Run, posterior: xr.Dataset) -> Drawing:
    """The paper's Fig. 4: marginal posteriors of λ/μ, with the truth where it is known."""
    groups = parameter_groups(run.mesh, posterior)
    with style.look():
        columns = min(4, len(groups))
        rows = -(-len(groups) // columns)
        figure = style.new_figure(2.5 * rows)
        axes = figure.subplots(rows, columns, squeeze=False)
        for panel in axes.ravel()[len(groups) :]:
            panel.remove()
        for panel, group in zip(axes.ravel(), groups, strict=False):
            ratio_panel(panel, run, group)
        uri = style.data_uri(figure, "svg")
    caption = (
        "The paper’s Fig. 4 for this run: marginal posterior of λ/μ. Filled: all chains together; thin lines: each "
        "chain by itself (they lie on one another where the chains agree); white dot and bar: median and central 95 % "
        "interval" + ("; dashed: truth, named at the edge where it lies far off." if run.truth is not None else ".")
    )
    medians = ", ".join(f"{group.name} {number(float(np.nanmedian(group.ratio)))}" for group in groups)
    return Drawing("stiffness", "Stiffness ratios", caption, f"Posterior histograms; medians of λ/μ: {medians}.", uri)


class Mark(NamedTuple):
    """A value to point out in a histogram, its label and colour."""

    value: float
    label: str
    colour: str


def ratio_panel(axes: Axes, run: Run, group: Group) -> None:
    """Histogram of λ/μ of one group, with its median, 95 % interval and truth."""
    colour = style.UNIFORM if group.name == "uniform" else _colour(run, group.name)
    truths = _true_ratios(run, group.name)
    one = len(truths) == 1
    marks = [
        Mark(value, "truth" if one else f"truth {style.literal(name)}", style.TRUTH if one else _colour(run, name))
        for name, value in truths.items()
    ]
    histogram(axes, group.ratio.reshape(len(group.ratio), -1), colour, marks, ratio=True)
    axes.set_title(style.literal(label_of(group.name)), weight="bold")
    axes.set_xlabel("λ / μ")


def histogram(axes: Axes, draws: np.ndarray, colour: str, marks: Sequence[Mark], ratio: bool = False) -> None:
    """Density of (chain, draw) values: pooled and filled, by chain as lines, with median, 95 % interval and marks.

    A ratio whose central interval spans more than a factor of twenty gets a logarithmic axis. A mark far outside
    the draws is named at the edge it lies beyond.
    """
    finite = draws[np.isfinite(draws)]
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    if finite.size == 0 or np.ptp(finite) == 0:
        value = number(float(finite[0])) if finite.size else "undefined"
        axes.text(0.5, 0.5, f"fixed: {value}" if finite.size else value, transform=axes.transAxes, ha="center")
        return
    low, median, high = (float(value) for value in np.quantile(finite, (0.025, 0.5, 0.975)))
    logarithmic = bool(ratio and low > 0 and high > LOG_SPAN * low)
    edges = _edges(finite, logarithmic)
    axes.set_xscale("log" if logarithmic else "linear")
    axes.stairs(_density(finite, edges, logarithmic), edges, fill=True, color=colour, alpha=0.45, lw=0)
    for chain, line in zip(draws, style.chain_colours(len(draws)), strict=True):
        axes.stairs(_density(chain[np.isfinite(chain)], edges, logarithmic), edges, color=line, lw=0.7, alpha=0.85)
    base = -0.05 * axes.get_ylim()[1]
    axes.plot([low, high], [base, base], color=colour, lw=3, solid_capstyle="butt")
    axes.plot([median], [base], "o", mfc="white", mec=colour, ms=5)
    axes.set_ylim(2 * base, axes.get_ylim()[1] * (1.22 if marks else 1.05))
    interval = f"{number(median)} [{number(low)}, {number(high)}]"
    axes.set_title(interval, fontsize=7, color=style.MUTED, loc="right")
    _point_out(axes, edges, marks, logarithmic)


def _point_out(axes: Axes, edges: np.ndarray, marks: Sequence[Mark], logarithmic: bool) -> None:
    """A dashed line at every mark near the draws, an arrow towards every other."""
    scale = np.log10 if logarithmic else np.asarray
    first, last = scale(edges[0]), scale(edges[-1])
    for index, mark in enumerate(marks):
        at = scale(mark.value) if mark.value > 0 or not logarithmic else -np.inf
        place: dict[str, Any] = {"color": mark.colour, "fontsize": 7, "va": "top"}
        if first - FAR * (last - first) <= at <= last + FAR * (last - first):
            axes.axvline(mark.value, color=mark.colour, ls=(0, (4, 2)), lw=1.2)
            place |= {"transform": axes.get_xaxis_transform(), "rotation": 90, "ha": "right"}
            axes.text(mark.value, 0.99, f"{mark.label} ", **place)
        else:
            below = at < first
            text = f"← {mark.label} {number(mark.value)}" if below else f"{mark.label} {number(mark.value)} →"
            place |= {"transform": axes.transAxes, "ha": "left" if below else "right"}
            axes.text(0.0 if below else 1.0, 0.98 - 0.09 * index, text, **place)


def _density(values: np.ndarray, edges: np.ndarray, logarithmic: bool) -> np.ndarray:
    """Per unit of the axis that is drawn, so that areas are probabilities to the eye."""
    return np.histogram(values, edges)[0] / max(1, values.size) / np.diff(np.log(edges) if logarithmic else edges)


def _edges(values: np.ndarray, logarithmic: bool) -> np.ndarray:
    low, high = np.quantile(values, (0.002, 0.998))
    if logarithmic:
        return np.geomspace(max(low, 1e-12), high, BINS)
    margin = 0.02 * (high - low) or 1e-9
    return np.linspace(low - margin, high + margin, BINS)


def _colour(run: Run, name: str) -> str:
    return dict(zip(run.mesh.names, colours_of(run.mesh.names), strict=True))[name]


def _true_ratios(run: Run, name: str) -> dict[str, float]:
    """λ/μ of the named tissue; of all tissues where the parameters are uniform."""
    if run.truth is None:
        return {}
    ratios = dict(zip(run.mesh.names, np.asarray(run.truth.lam) / np.asarray(run.truth.mu), strict=True))
    return {key: float(ratio) for key, ratio in ratios.items() if name in (key, "uniform")}


def temperatures(run: Run, posterior: xr.Dataset) -> Drawing | None:
    """Trace and marginal of every sampled temperature with its prior; None where none is sampled."""
    sampled = sampled_scales(posterior)
    if not sampled:
        return None
    with style.look():
        figure = style.new_figure(1.9 * len(sampled) + 0.2)
        axes = figure.subplots(len(sampled), 2, width_ratios=[2, 1], squeeze=False)
        for (left, right), name in zip(axes, sampled, strict=True):
            draws = np.asarray(posterior[name].transpose("chain", "draw").to_numpy(), float)
            for chain, colour in zip(draws, style.chain_colours(len(draws)), strict=True):
                left.plot(chain, color=colour, lw=0.6, alpha=0.85)
            left.set(xlim=(0, max(1, draws.shape[1] - 1)), xlabel="draw", ylabel=_math(name))
            histogram(right, draws, style.UNIFORM, [])
            _prior_line(right, part(run.manifest, "model", name))
            right.set_xlabel(_math(name))
        uri = style.data_uri(figure)
    caption = (
        "Temperatures and sds that were sampled, too. Left: every chain over its kept draws. Right: all chains "
        "together (filled) and each by itself, with median and 95 % interval; dashed: the log-normal prior."
    )
    alt = "Traces and histograms of " + " and ".join(map(symbol_of, sampled)) + "."
    return Drawing("temperatures", "Temperatures", caption, alt, uri)


def _math(name: str) -> str:
    """A symbol as Matplotlib sets it."""
    return f"${SYMBOLS[name]}$" if name in SYMBOLS else symbol_of(name)


def _prior_line(axes: Axes, prior: Any) -> None:
    """Density of a log-normal prior over the range that is shown."""
    if not isinstance(prior, Mapping):
        return
    low, high = axes.get_xlim()
    x = np.linspace(max(low, 1e-9 * high), high, 300)
    density = stats.lognorm.pdf(x, float(prior["log_sd"]), scale=float(prior["median"]))
    axes.plot(x, density, color=style.ACCENT, ls=(0, (4, 2)), lw=1.1)
    axes.set_xlim(low, high)


class SkullNode(NamedTuple):
    """A sampled node and how close to the skull its draws come.

    Attributes
    ----------
    entry : int
        Position along the posterior's `node` axis.
    node : int
        Index in the mesh.
    near : float
        Fraction of draws within 0.25 mm of the skull.
    """

    entry: int
    node: int
    near: float


def node_at_skull(run: Run, posterior: xr.Dataset) -> SkullNode:
    """The sampled node with most draws at the skull; without a skull, the one that moves most."""
    draws = posterior["u_boundary"].transpose("chain", "draw", "node", "axis")
    nodes = draws["node"].to_numpy().astype(int)
    if run.skull is None:
        entry = int(np.linalg.norm(np.asarray(run.u_mean)[nodes], axis=1).argmax())
        return SkullNode(entry, int(nodes[entry]), 0.0)
    stride = max(1, draws.sizes["chain"] * draws.sizes["draw"] // SEARCH_DRAWS)
    some = draws.isel(draw=slice(None, None, stride)).to_numpy().reshape(-1, len(nodes), 3)
    at = run.mesh.points[nodes] + some
    distance = skull_distance(run.skull, at.reshape(-1, 3)).reshape(len(at), len(nodes))
    near, mean = (np.abs(distance) < NEAR).mean(axis=0), np.abs(distance).mean(axis=0)
    entry = int(np.lexsort((mean, -near))[0])
    return SkullNode(entry, int(nodes[entry]), float(near[entry]))


def skull_distance(skull: Image, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
    """Signed distance to the skull (mm, negative inside it) of some points, cut off at ±6 mm.

    Only the voxels about the points are looked at: the distance map of a whole image takes seconds.
    """
    indices = skull.world_to_voxel(points)
    reach = REACH / skull.voxel_sizes + 9
    low = np.clip(np.floor(indices.min(axis=0) - reach), 0, skull.shape).astype(int)
    high = np.clip(np.ceil(indices.max(axis=0) + reach) + 1, 0, skull.shape).astype(int)
    window = np.asarray(skull.voxels)[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    if not (window == 0).any():
        return np.full(len(points), -REACH)
    affine = skull.affine.copy()
    affine[:3, 3] = skull.voxel_to_world(low.astype(float))
    return np.clip(sample(signed_distance(Image(window, affine), REACH), points, outside=-REACH), -REACH, REACH)


def skull_node(run: Run, posterior: xr.Dataset) -> Drawing:
    """The paper's Fig. 5: marginals of one node at the skull, where it is, and its distance to the skull."""
    chosen = node_at_skull(run, posterior)
    stride = max(1, posterior.sizes["draw"] // SHOWN_DRAWS)
    draws = posterior["u_boundary"].transpose("chain", "draw", "node", "axis").isel(node=chosen.entry)
    u = np.asarray(draws.isel(draw=slice(None, None, stride)).to_numpy(), float)
    place = run.mesh.points[chosen.node]
    with style.look():
        figure = style.new_figure(2.5)
        count = 4 if run.skull is None else 5
        axes = figure.subplots(1, count, width_ratios=[1.15] + [1.0] * (count - 1))
        _neighbourhood(axes[0], run, place, u)
        for k, panel in enumerate(axes[1:4]):
            _component(panel, u[..., k], COORDINATES[k], _true_component(run.truth, chosen.node, k))
        if run.skull is not None:
            _to_skull(axes[4], skull_distance(run.skull, (place + u).reshape(-1, 3)).reshape(u.shape[:2]))
        for letter, panel in zip("abcde", axes, strict=False):
            panel.set_title(f"({letter})", fontsize=8)
        uri = style.data_uri(figure)
    where = f"node {chosen.node} at {place_text((float(place[0]), float(place[1]), float(place[2])))}"
    title = "One node" if run.skull is None else "One node at the skull"
    return Drawing("node", title, _node_caption(run, chosen, where), f"Marginals of u of {where}.", uri)


def _node_caption(run: Run, chosen: SkullNode, where: str) -> str:
    if run.skull is None:
        choice = f"No skull bounds this run; shown is the node that moves most, {where}."
    else:
        share = f"{chosen.near:.0%}".replace("%", " %")
        choice = f"Shown is the sampled node with most draws within {NEAR:g} mm of the skull ({share}), {where}."
    last = "" if run.skull is None else " (e) distance to the skull, which cuts the posterior off at zero."
    shaded = "" if run.skull is None else ", the skull shaded"
    truth = "; dashed: truth" if run.truth is not None else ""
    return (
        f"The paper’s Fig. 5 for this run. {choice} (a) its place at rest (ring) and drawn positions (dots) on the "
        f"fixed image{shaded}; (b–d) marginals of u along x, y and z with median and 95 % interval, pooled "
        f"(filled) and by chain (lines){truth}.{last}"
    )


def _true_component(truth: Truth | None, node: int, axis: int) -> float | None:
    return None if truth is None else float(np.asarray(truth.u)[node, axis])


def _component(axes: Axes, draws: np.ndarray, name: str, truth: float | None) -> None:
    histogram(axes, draws, style.UNIFORM, [] if truth is None else [Mark(truth, "truth", style.TRUTH)])
    axes.set_xlabel(f"$u_{name}$, mm")


def _to_skull(axes: Axes, distance: np.ndarray) -> None:
    histogram(axes, distance, style.UNIFORM, [])
    axes.axvline(0, color=style.SKULL, lw=1.4)
    axes.axvspan(axes.get_xlim()[0], 0, color=style.SKULL, alpha=0.25, lw=0, zorder=0)
    axes.set_xlabel("distance to skull, mm")


def _neighbourhood(axes: Axes, run: Run, place: np.ndarray, u: np.ndarray) -> None:
    """Image, skull and draws on the plane that shows the way to the skull best."""
    axis = _level_axis(run, place)
    across, up = IN_PLANE[axis]
    centre = place + u.reshape(-1, 3).mean(axis=0)
    sides = [(float(centre[k] - ZOOM), float(centre[k] + ZOOM)) for k in (across, up)]
    plane = Plane(axis, float(centre[axis]), sides[0], sides[1], 2 * ZOOM / 200)
    panels.image_panel(axes, run.background, plane, panels.grey_limits(run))
    if run.skull is not None:
        forbidden = sample(run.skull, plane.points(), order=0, outside=1.0) != 0
        shade = np.where(forbidden[..., None], (*_rgb(style.SKULL), 0.72), 0.0)
        panels.field_panel(axes, shade, plane, Normalize(0, 1), style.GREY, dark=True)
    stride = max(1, u.shape[1] * len(u) // CLOUD_DRAWS)
    for chain, colour in zip(place + u, style.chain_colours(len(u)), strict=True):
        axes.plot(chain[::stride, across], chain[::stride, up], ".", ms=2, color=colour, alpha=0.8, mew=0)
    axes.plot([place[across]], [place[up]], "o", mfc="none", mec="#f5d76e", ms=7, mew=1.4)


def _level_axis(run: Run, place: np.ndarray) -> int:
    """The world axis along which the distance to the skull (else u) changes least."""
    if run.skull is None:
        return 2
    steps = np.concatenate([np.eye(3), -np.eye(3)]) * float(run.skull.voxel_sizes.mean())
    values = skull_distance(run.skull, place + steps)
    return int(np.abs(values[:3] - values[3:]).argmin())


def _rgb(colour: str) -> tuple[float, float, float]:
    red, green, blue = (int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue
