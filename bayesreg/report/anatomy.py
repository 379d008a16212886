"""Figures on anatomy: before and after, the data and the mesh (Fig. 2), the result (Fig. 3), the uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from bayesreg.image import Image
from bayesreg.io.records import Predicted, Run
from bayesreg.report import panels, style
from bayesreg.report.adequacy import explain_difference
from bayesreg.report.estimands import elastic_draws
from bayesreg.report.metrics import divergence
from bayesreg.report.panels import View
from bayesreg.report.slices import Plane, planes_through, sample
from bayesreg.report.style import Drawing
from bayesreg.report.verdict import number

CONVENTION = (
    "Neurological convention: the left of the patient is on the left (L left, R right, A anterior, P posterior, "
    "S superior, I inferior)."
)
INTENSITY = "intensity (scaled)"
MAX_VOXELS = 200_000
MEDIAN_DRAWS = 500


def registration(view: View) -> Drawing | None:
    """Fixed, moving and warped image, and what is between them before and after, on three planes; None without images.

    That is their difference, or, where they are of unlike contrast, the tissues of the fixed image drawn on the others.
    """
    run = view.run
    if run.fixed is None or run.moving is None or run.warped is None:
        return None
    if not run.matching.one_contrast:
        return _unlike(view, {"fixed f": run.fixed, "moving m": run.moving, "warped m(x + ū)": run.warped})
    limits = panels.grey_limits(run)
    columns = {"fixed f": run.fixed, "moving m": run.moving, "warped m(x + ū)": run.warped}
    before, after = residual_sd(run, run.moving), residual_sd(run, run.warped)
    with style.look():
        figure, axes = _grid(view, columns=5)
        planes = view.planes[::-1]
        sampled = [[sample(image, plane.points()) for image in columns.values()] for plane in planes]
        changes = [
            [_inside(view, plane, image - f) for image in (m, w)]
            for plane, (f, m, w) in zip(planes, sampled, strict=True)
        ]
        norm = panels.symmetric(np.concatenate([before.ravel() for before, _ in changes]))
        for row, plane, change in zip(axes, planes, changes, strict=True):
            fixed, moving, warped = panels.ignored(view, plane)
            for panel, image in zip(row, columns.values(), strict=False):
                panels.image_panel(panel, image, plane, limits)
            for panel, picture in zip(row[3:], change, strict=True):
                drawn = panels.field_panel(panel, picture, plane, norm, style.SIGNED)
            for panel, mask in zip(row, (fixed, moving, warped, fixed | moving, fixed | warped), strict=True):
                panels.hatch(panel, plane, mask)
            note(row[0], plane.title)
        panels.colourbar(figure, drawn, list(axes[:, 3:].ravel()), INTENSITY, shrink=0.6)
        for panel, title in zip(axes[0], [*columns, "before: m − f", "after: m(x + ū) − f"], strict=True):
            panel.set_title(title)
        uri = style.data_uri(figure)
    caption = (
        f"{_focus(view)} Differences are shown inside the mesh; their root mean square over the "
        f"mesh falls from {before:.3f} to {after:.3f} (in units of the scaled intensity).{_of_ignored(run)} "
        f"{CONVENTION}{explain_difference(run.manifest)}"
    )
    alt = f"Fixed, moving and warped images with differences; the residual falls from {before:.3f} to {after:.3f}."
    return Drawing("registration", "Before and after", caption, alt, uri)


def _of_ignored(run: Run) -> str:
    """A sentence about what is hatched; empty where nothing is."""
    if run.fixed_ignore is None and run.moving_ignore is None:
        return ""
    return " What is hatched is ignored: the image says nothing there."


def _unlike(view: View, columns: Mapping[str, Image]) -> Drawing:
    """Images of unlike contrast, each in its own greys, and with the borders of the fixed image's tissues."""
    with style.look():
        figure, axes = _grid(view, columns=len(columns))
        for row, plane in zip(axes, view.planes[::-1], strict=True):
            for panel, image in zip(row, columns.values(), strict=True):
                panels.image_panel(panel, image, plane, panels.range_of(image))
                panels.label_lines(panel, view.run, plane)
            for panel, mask in zip(row, panels.ignored(view, plane), strict=True):
                panels.hatch(panel, plane, mask)
            note(row[0], plane.title)
        for panel, title in zip(axes[0], columns, strict=True):
            panel.set_title(title)
        uri = style.data_uri(figure)
    caption = (
        f"{_focus(view)} The images are of unlike contrast, so that no difference of theirs is shown; the lines are "
        f"the borders of the tissues in the fixed image, and should lie on those of the warped one."
        f"{_of_ignored(view.run)} {CONVENTION}"
    )
    alt = "Fixed, moving and warped images, and the borders of the fixed image's tissues on each."
    return Drawing("registration", "Before and after", caption, alt, uri)


def data(view: View) -> Drawing:
    """The paper's Fig. 2: images, labels, mesh cut, divergence and components of the (true) displacement."""
    run, plane, limits = view.run, view.main, panels.grey_limits(view.run)
    u, whose = panels.true_or_mean_displacement(run), "posterior mean" if run.truth is None else "true"
    symbol = "ū" if run.truth is None else "u"
    labels = "labels" if run.skull is None else "labels and skull"
    with style.look():
        figure, axes = _rows(plane, 2, legend=True)
        panels.image_panel(axes[0, 0], run.background, plane, limits)
        panels.label_panel(axes[0, 1], run, plane)
        panels.mesh_panel(axes[0, 2], run.mesh, plane)
        if run.moving is None:
            axes[0, 3].set_axis_off()
        else:
            panels.image_panel(axes[0, 3], run.moving, plane, limits)
        _divergence(figure, axes[1, 0], view, u)
        components = view.slice(plane).nodal(u)
        norm = panels.symmetric(components)
        for k, panel in enumerate(axes[1, 1:]):
            drawn = panels.field_panel(panel, components[..., k], plane, norm, style.SIGNED)
            panels.outline(panel, view, plane)
        panels.colourbar(figure, drawn, list(axes[1, 1:]), "mm", location="bottom")
        background = "tissue map" if run.fixed is None else "fixed f"
        titles = (background, labels, "mesh cut", "moving m" if run.moving else "", f"div {symbol}")
        _letter(axes, [*titles, *(f"{symbol} along {axis}" for axis in ("x (R)", "y (A)", "z (S)"))])
        handles = panels.tissue_legend(run.mesh.names, run.skull is not None)
        figure.legend(handles=handles, loc="outside lower center", ncols=8)
        uri = style.data_uri(figure)
    caption = (
        f"The paper’s Fig. 2 for this run, {plane.title}: {background}, {labels}, exact cut through the "
        f"mesh ({len(run.mesh.points):,} nodes, {len(run.mesh.cells):,} tetrahedra, {len(run.mesh.boundary):,} "
        f"boundary nodes){'' if run.moving is None else ', moving image'}; below, divergence and components of the "
        f"{whose} displacement. Negative "
        "divergence, blue, is loss of volume."
    )
    alt = f"Images, labels, mesh, divergence and displacement on the {plane.title} plane."
    return Drawing("data", "The data, the mesh and the displacement", caption, alt, uri)


def result(view: View) -> Drawing:
    """The paper's Fig. 3: error where the truth is known (else |ū|), standard deviation, divergence, warped image."""
    run, plane = view.run, view.main
    known = run.truth is not None
    with style.look():
        figure, axes = _rows(plane, 1)
        first = view.error(plane) if known else view.magnitude(plane)
        cmap = style.ERROR if known else style.MAGNITUDE
        _magnitude(figure, axes[0, 0], view, plane, first, cmap)
        _magnitude(figure, axes[0, 1], view, plane, view.spread(plane), style.ERROR)
        _divergence(figure, axes[0, 2], view, np.asarray(run.u_mean), like=panels.true_or_mean_displacement(run))
        if run.warped is None:
            axes[0, 3].set_axis_off()
        else:
            drawn = panels.image_panel(axes[0, 3], run.warped, plane, panels.grey_limits(run))
            panels.colourbar(figure, drawn, axes[0, 3], INTENSITY, location="bottom")
        _letter(
            axes, ["|ū − u|" if known else "|ū|", "posterior sd of u", "div ū", "warped m(x + ū)" if run.warped else ""]
        )
        uri = style.data_uri(figure)
    left = "norm of the error of the posterior mean" if known else "norm of the posterior mean (no truth is known)"
    caption = (
        f"The paper’s Fig. 3 for this run, {plane.title}: {left}; posterior standard deviation (root of the "
        "summed variances of the three components); divergence of the mean, on the colour scale of the figure before"
        + ("." if run.warped is None else "; the warped image.")
    )
    return Drawing("result", "Error and uncertainty", caption, f"Four panels on the {plane.title} plane: {left}.", uri)


def displacement(view: View) -> Drawing:
    """Norm of the mean with arrows, standard deviation, and error where known, on three planes."""
    run, planes = view.run, view.planes[::-1]
    rows = [("|ū|", style.MAGNITUDE, view.magnitude), ("posterior sd", style.ERROR, view.spread)]
    if run.truth is not None:
        rows.append(("|ū − u|", style.ERROR, view.error))
    with style.look():
        figure, axes = _field_grid(view, len(rows))
        pictured = [[values(plane) for plane in planes] for _, _, values in rows]
        # One scale for standard deviation and error: it shows whether the one explains the other.
        norms = [panels.from_zero(*pictured[0])]
        norms += [panels.from_zero(*chain.from_iterable(pictured[1:]))] * (len(rows) - 1)
        for index, (row, (name, cmap, _), pictures, norm) in enumerate(zip(axes, rows, pictured, norms, strict=True)):
            for panel, plane, picture in zip(row, planes, pictures, strict=True):
                drawn = panels.field_panel(panel, picture, plane, norm, cmap)
                panels.outline(panel, view, plane, interfaces=index > 0)
            panels.colourbar(figure, drawn, list(row), f"{name}, mm")
        for panel, plane in zip(axes[0], planes, strict=True):
            panels.arrows(panel, view, plane, np.asarray(run.u_mean))
            panel.set_title(plane.title)
        uri = style.data_uri(figure)
    second = "Bottom" if run.truth is None else "Middle"
    caption = (
        "Top: norm of the posterior mean; arrows show its in-plane part at true length, from the fixed point to the "
        f"moving point. {second}: posterior standard deviation (root of the summed variances of the three components)."
    )
    caption += " Bottom: norm of the error of the mean, on the same colour scale." if run.truth is not None else ""
    alt = "Displacement and its uncertainty on an axial, a coronal and a sagittal plane."
    return Drawing("displacement", "Displacement in three planes", caption, alt, uri)


def residual_sd(run: Run, image: Image) -> float:
    """Root mean square of an image less the fixed one over labelled voxels (an even sample of the grid)."""
    assert run.fixed is not None
    stride = max(1, int(np.prod(run.fixed.shape) // MAX_VOXELS))
    indices = np.stack(np.unravel_index(np.arange(0, np.prod(run.fixed.shape), stride), run.fixed.shape), axis=-1)
    points = np.asarray(run.fixed.voxel_to_world(indices.astype(float)))
    inside = sample(run.tissue, points, order=0, outside=0.0) > 0
    difference = sample(image, points[inside]) - np.asarray(run.fixed.voxels, float)[tuple(indices[inside].T)]
    return float(np.sqrt(np.nanmean(difference**2)))


def _inside(view: View, plane: Plane, picture: np.ndarray) -> np.ndarray:
    return np.where(view.slice(plane).inside, picture, np.nan)


def _magnitude(figure: Figure, axes: Axes, view: View, plane: Plane, picture: np.ndarray, cmap: str) -> None:
    drawn = panels.field_panel(axes, picture, plane, panels.from_zero(picture), cmap)
    panels.outline(axes, view, plane)
    panels.colourbar(figure, drawn, axes, "mm", location="bottom")


def _divergence(figure: Figure, axes: Axes, view: View, u: np.ndarray, like: np.ndarray | None = None) -> None:
    norm = panels.symmetric(divergence(view.run.mesh, u if like is None else like), quantile=0.98)
    drawn = panels.field_panel(axes, view.divergence(view.main, u), view.main, norm, style.SIGNED)
    panels.outline(axes, view, view.main)
    panels.colourbar(figure, drawn, axes, "relative volume change", location="bottom")


def _focus(view: View) -> str:
    return (
        "Planes through the node of greatest displacement, moved inwards where they would only graze the organ: "
        + "; ".join(plane.title for plane in view.planes[::-1])
        + "."
    )


def note(axes: Axes, text: str) -> None:
    """Write what a row of panels shows at its left, upwards."""
    place: dict[str, Any] = {"transform": axes.transAxes, "rotation": 90, "ha": "right", "va": "center"}
    axes.text(-0.03, 0.5, text, fontsize=8, color=style.MUTED, **place)


def _letter(axes: np.ndarray, titles: list[str]) -> None:
    for letter, panel, title in zip("abcdefgh", axes.ravel(), titles, strict=False):
        panel.set_title(f"({letter}) {title}" if title else "")


def _rows(plane: Plane, rows: int, legend: bool = False) -> tuple[Figure, np.ndarray]:
    """Four panels a row on one plane."""
    height = style.WIDTH / 4.3 * np.ptp(plane.vertical) / np.ptp(plane.horizontal) + 0.55
    figure = style.new_figure(rows * height + 0.4 * legend)
    return figure, figure.subplots(rows, 4, squeeze=False)


def _grid(view: View, columns: int) -> tuple[Figure, np.ndarray]:
    """Rows axial, coronal and sagittal at one scale."""
    heights = [float(np.ptp(plane.vertical)) for plane in view.planes[::-1]]
    width = max(np.ptp(plane.horizontal) for plane in view.planes)
    figure = style.new_figure(style.WIDTH / (columns + 0.35) * sum(heights) / width + 0.4)
    return figure, figure.subplots(3, columns, height_ratios=heights)


def _field_grid(view: View, rows: int) -> tuple[Figure, np.ndarray]:
    """Columns axial, coronal and sagittal at one scale."""
    widths = [float(np.ptp(plane.horizontal)) for plane in view.planes[::-1]]
    height = max(np.ptp(plane.vertical) for plane in view.planes)
    figure = style.new_figure(rows * 0.93 * style.WIDTH * height / sum(widths) + 0.3)
    return figure, figure.subplots(rows, 3, width_ratios=widths, squeeze=False)


def element_stiffness(view: View, posterior: xr.Dataset) -> Drawing | None:
    """Posterior median of λ/μ of every element on three planes; None unless the parameters vary by element."""
    ratio = element_ratio(view.run, posterior)
    if ratio is None:
        return None
    planes = view.planes[::-1]
    with style.look():
        figure, axes = _field_grid(view, 1)
        norm = LogNorm(*np.nanquantile(ratio, (0.01, 0.99)))
        for panel, plane in zip(axes[0], planes, strict=True):
            drawn = panels.field_panel(panel, view.slice(plane).cellwise(ratio), plane, norm, style.MAGNITUDE)
            panels.outline(panel, view, plane)
            panel.set_title(plane.title)
        panels.colourbar(figure, drawn, list(axes[0]), "median of λ/μ")
        uri = style.data_uri(figure)
    caption = "Posterior median of λ/μ of every tetrahedron; lines: interfaces of the tissues."
    return Drawing("elements", "Stiffness by element", caption, "Maps of the median of λ/μ on three planes.", uri)


def stiffness_field(view: View, predicted: Predicted) -> Drawing | None:
    """Mean, sd and P(> 1.5) of every element's stiffness over its tissue's; None unless there is a field."""
    if predicted.stiffness_mean is None:
        return None
    mean, sd, likely = (np.asarray(values) for values in (
        predicted.stiffness_mean, predicted.stiffness_sd, predicted.stiffer_probability
    ))  # fmt: skip
    span = float(np.abs(np.log(mean)).max()) + 1e-3
    times = float(np.asarray(predicted.stiffer))
    rows = [
        ("mean", mean, style.SIGNED, LogNorm(np.exp(-span), np.exp(span))),
        ("sd", sd, style.ERROR, panels.from_zero(sd)),
        (f"P(> {times:g})", likely, style.MAGNITUDE, Normalize(0, 1)),
    ]
    place = view.run.mesh.points[view.run.mesh.cells[mean.argmax()]].mean(axis=0)
    planes = planes_through(view.run.mesh, place)[::-1]
    with style.look():
        figure, axes = _field_grid(view, len(rows))
        for row, (name, values, cmap, norm) in zip(axes, rows, strict=True):
            for panel, plane in zip(row, planes, strict=True):
                drawn = panels.field_panel(panel, view.slice(plane).cellwise(values), plane, norm, cmap)
                panels.outline(panel, view, plane)
            panels.colourbar(figure, drawn, list(row), name)
        for panel, plane in zip(axes[0], planes, strict=True):
            panel.set_title(plane.title)
        uri = style.data_uri(figure)
    caption = (
        "Stiffness of every tetrahedron over the geometric mean of its tissue: posterior mean, standard deviation and "
        f"the probability of more than {times:g} times, through the stiffest tetrahedron "
        f"({number(float(mean.max()))} ± {number(float(sd[mean.argmax()]))} times); lines: interfaces of the tissues."
    )
    return Drawing("field", "Stiffness within the tissues", caption, "Maps of mean, sd and probability.", uri)


def element_ratio(run: Run, posterior: xr.Dataset) -> np.ndarray | None:
    """Posterior median of λ/μ of every element, NaN where μ may be 0; None unless the parameters vary by element."""
    lam, mu = elastic_draws(posterior, MEDIAN_DRAWS)
    if lam.shape[2:] != (len(run.mesh.cells),):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = lam / mu
    return np.median(np.where(ratio > 0, ratio, np.nan), axis=(0, 1))
