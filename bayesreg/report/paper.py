"""The paper's Figs. 2, 3 and 5 for a run: the data and the mesh, the result, and one node at the skull."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import ndimage
from scipy.spatial import cKDTree

from bayesreg.image import Image
from bayesreg.io.records import Run
from bayesreg.report import panels, style
from bayesreg.report.marginals import Mark, histogram
from bayesreg.report.metrics import divergence
from bayesreg.report.panels import View
from bayesreg.report.slices import COORDINATES, Plane
from bayesreg.report.study import Study
from bayesreg.report.style import Drawing
from bayesreg.report.verdict import place_text


def data(study: Study) -> Drawing:
    """Draw Fig. 2: images, labels, section of the mesh, divergence and components of the (true) displacement."""
    run, view, plane = study.run, study.view, study.view.main
    u, symbol = panels.true_or_mean_displacement(run), "ū" if run.truth is None else "u"
    with style.look():
        figure, axes = _rows(plane, 2)
        panels.image_panel(axes[0, 0], run.background, plane, panels.grey_limits(run))
        panels.label_panel(axes[0, 1], run, plane)
        panels.mesh_panel(axes[0, 2], run.mesh, plane)
        _image(axes[0, 3], run, run.moving, plane)
        _divergence(figure, axes[1, 0], view, u, u)
        components = view.slice(plane).nodal(u)
        norm = panels.symmetric(components)
        for k, panel in enumerate(axes[1, 1:]):
            drawn = panels.field_panel(panel, components[..., k], plane, norm, style.SIGNED)
            panels.outline(panel, view, plane)
        panels.colourbar(figure, drawn, list(axes[1, 1:]), "mm", location="bottom")
        titles = ["fixed f", "labels and skull", "mesh cut", "moving m", f"div {symbol}"]
        _letter(axes, [*titles, *(f"{symbol} along {axis}" for axis in ("x (R)", "y (A)", "z (S)"))])
        handles = panels.tissue_legend(run.mesh.names, run.skull is not None)
        figure.legend(handles=handles, loc="outside lower center", ncols=8)
        uri = style.data_uri(figure)
    mesh, whose = run.mesh, "posterior mean" if run.truth is None else "true"
    caption = (
        f"Plane: {plane.title}. The mesh has {len(mesh.points):,} nodes ({len(mesh.boundary):,} on the boundary) and "
        f"{len(mesh.cells):,} tetrahedra. Below: divergence (blue: loss of volume) and components of the {whose} "
        "displacement."
    )
    return Drawing("data", "Fig. 2: data, mesh and displacement", caption, "Images, labels, mesh, displacement.", uri)


def result(study: Study) -> Drawing:
    """Draw Fig. 3: error if the truth is known (else |ū|), standard deviation, divergence, warped image."""
    run, view, plane = study.run, study.view, study.view.main
    has_truth = run.truth is not None
    first = ("|ū − u|", panels.error_of(run), style.ERROR) if has_truth else ("|ū|", run.u_mean, style.MAGNITUDE)
    shown = [first, ("posterior sd of u", run.u_sd, style.ERROR)]
    with style.look():
        figure, axes = _rows(plane, 1)
        for panel, (_, vectors, cmap) in zip(axes[0], shown, strict=False):
            picture = view.norm(plane, vectors)
            drawn = panels.field_panel(panel, picture, plane, panels.from_zero(picture), cmap)
            panels.outline(panel, view, plane)
            panels.colourbar(figure, drawn, panel, "mm", location="bottom")
        _divergence(figure, axes[0, 2], view, np.asarray(run.u_mean), panels.true_or_mean_displacement(run))
        _image(axes[0, 3], run, run.warped, plane)
        _letter(axes, [*(title for title, *_ in shown), "div ū", "m(x + ū)"])
        uri = style.data_uri(figure)
    caption = (
        f"Plane: {plane.title}. The standard deviation is the root of the summed variances of the three components."
    )
    caption += "" if has_truth else " No truth is known."
    return Drawing("result", "Fig. 3: error and uncertainty", caption, "Four panels on one plane.", uri)


def _image(axes: Axes, run: Run, image: Image | None, plane: Plane) -> None:
    """Draw an image if there is one."""
    if image is None:
        axes.set_axis_off()
    else:
        panels.image_panel(axes, image, plane, panels.grey_limits(run))


def _divergence(figure: Figure, axes: Axes, view: View, u: np.ndarray, like: np.ndarray) -> None:
    """Draw div u, on the colours that suit the divergence of another field."""
    norm = panels.symmetric(divergence(view.run.mesh, like), quantile=0.98)
    drawn = panels.field_panel(axes, view.divergence(view.main, u), view.main, norm, style.SIGNED)
    panels.outline(axes, view, view.main)
    panels.colourbar(figure, drawn, axes, "relative volume change", location="bottom")


def _letter(axes: np.ndarray, titles: list[str]) -> None:
    for letter, panel, title in zip("abcdefgh", axes.ravel(), titles, strict=False):
        panel.set_title(f"({letter}) {title}")


def _rows(plane: Plane, rows: int) -> tuple[Figure, np.ndarray]:
    """Make rows of four panels on one plane."""
    height = style.WIDTH / 4.3 * np.ptp(plane.vertical) / np.ptp(plane.horizontal) + 0.55
    figure = style.new_figure(rows * height + 0.4)
    return figure, figure.subplots(rows, 4, squeeze=False)


def node(study: Study) -> Drawing | None:
    """Draw Fig. 5: marginals of the displacement of one node at the skull; None without skull or sampled nodes."""
    run, entry = study.run, node_at_skull(study)
    if entry is None:
        return None
    draws = study.posterior["u_boundary"].transpose("chain", "draw", "node", "axis").isel(node=entry)
    u, number = np.asarray(draws.to_numpy(), float), int(draws["node"])
    with style.look():
        figure = style.new_figure(2.5)
        for k, panel in enumerate(figure.subplots(1, 3)):
            truth = [] if run.truth is None else [Mark(float(run.truth.u[number, k]), "truth", style.TRUTH)]
            histogram(panel, u[..., k], style.UNIFORM, truth)
            panel.set_xlabel(f"$u_{COORDINATES[k]}$, mm")
        uri = style.data_uri(figure, "svg")
    caption = f"Node {number} at {place_text(run.mesh.points[number])}, whose mean place is the nearest to the skull."
    return Drawing("node", "Fig. 5: one node at the skull", caption, f"Marginals of u of node {number}.", uri)


def node_at_skull(study: Study) -> int | None:
    """Find the entry along `node` whose mean place is nearest to the skull; None without skull or sampled nodes."""
    nodes, skull = study.posterior["node"].to_numpy().astype(int), study.run.skull
    if skull is None or not len(nodes):
        return None
    forbidden = np.asarray(skull.voxels) != 0
    border = forbidden & ~ndimage.binary_erosion(forbidden, border_value=1)
    places = study.mesh.points[nodes] + np.asarray(study.run.u_mean)[nodes]
    distance, _ = cKDTree(skull.voxel_to_world(np.argwhere(border).astype(float))).query(places)
    return int(distance.argmin())
