"""How far to trust the displacement, in millimetres: maps, and regions at places."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.patches import Ellipse

from bayesreg.io.records import Predicted
from bayesreg.report import panels, style
from bayesreg.report.panels import View
from bayesreg.report.places import regions
from bayesreg.report.slices import IN_PLANE, NAMES, Plane
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import fixed, number, percent, place_text
from bayesreg.types import AnyArray

LEVEL = 0.95
BANDS = BoundaryNorm([0, 0.01, 0.05, 0.25, 0.5, 0.75, 1], 256)
COLUMNS = 6
ZOOM = 4.0
CLOUD = 300


class Region(NamedTuple):
    """The ellipsoid about the mean of some draws, shaped as their covariance, that holds 95 % of them.

    Attributes
    ----------
    mean : (3,) array
        mm.
    shape : (3, 3) array
        Semi-axes are the roots of its eigenvalues, mm².
    """

    mean: Float[np.ndarray, "3"]
    shape: Float[np.ndarray, "3 3"]

    @property
    def semi_axes(self) -> Float[np.ndarray, "3"]:
        """Longest first, mm."""
        return np.sqrt(np.clip(np.linalg.eigvalsh(self.shape), 0, None))[::-1]


def region(draws: Float[AnyArray, "draws 3"]) -> Region:
    """The 95 % region of draws; its size is counted off the draws, not taken from the Normal distribution."""
    draws = np.asarray(draws, float)
    mean, covariance = draws.mean(axis=0), np.cov(draws, rowvar=False) if len(draws) > 1 else np.zeros((3, 3))
    offset = draws - mean
    squared = np.einsum("di,ij,dj->d", offset, np.linalg.pinv(covariance, hermitian=True), offset)
    return Region(mean, covariance * np.quantile(squared, LEVEL))


def place_table(view: View, predicted: Predicted) -> Table:
    """Displacement and 95 % region of every place."""
    words = regions(view.run.mesh, predicted.place_points)
    rows = []
    for k, (name, point) in enumerate(zip(predicted.place_names, predicted.place_points, strict=True)):
        draws = np.asarray(predicted.place_draws)[:, :, k].reshape(-1, 3)
        found = region(draws)
        far = (np.linalg.norm(draws - found.mean, axis=1) > predicted.far_mm).mean()
        rows.append(
            [
                str(name),
                place_text((float(point[0]), float(point[1]), float(point[2]))),
                words[k],
                ", ".join(fixed(float(x), 1) for x in found.mean),
                fixed(float(np.linalg.norm(found.mean)), 1),
                " × ".join(fixed(float(x)) for x in found.semi_axes),
                percent(float(far)),
            ]
        )
    caption = (
        "Mean displacement (to the right, to the front, upwards) and the semi-axes of the ellipsoid that holds 95 % of "
        f"{draws.shape[0]:,} evenly spaced draws; last, the share of draws more than {predicted.far_mm:g} mm from the "
        "mean. Where no places are given some are chosen; report.places in the configuration names others."
    )
    header = ["", "Place (x, y, z)", "Where", "Shift x, y, z, mm", "Norm, mm", "95 % semi-axes, mm", _beyond(predicted)]
    return Table("Places", caption, header, [("", rows)])


def _beyond(predicted: Predicted) -> str:
    return f"P(> {predicted.far_mm:g} mm)"


def places(view: View, predicted: Predicted) -> Drawing:
    """Where each place goes, on the moving image: the draws and their 95 % region."""
    count = len(predicted.place_names)
    bands, columns = -(-count // COLUMNS), min(max(count, 4), COLUMNS)
    size = style.WIDTH / columns
    with style.look():
        figure = style.new_figure(bands * (3 * size + 0.35))
        axes = figure.subplots(3 * bands, columns, squeeze=False)
        limits = panels.grey_limits(view.run)
        for k, name in enumerate(predicted.place_names):
            band, column = divmod(k, COLUMNS)
            for row, axis in enumerate((2, 1, 0)):
                _place(axes[3 * band + row, column], view, predicted, k, axis, limits)
            axes[3 * band, column].set_title(style.literal(str(name)), fontsize=8)
        for band in range(bands):
            for row, axis in enumerate((2, 1, 0)):
                axes[3 * band + row, 0].set_ylabel(NAMES[axis], fontsize=8, color=style.MUTED)
        for panel in axes.ravel():
            if not panel.has_data():
                panel.remove()
        uri = style.data_uri(figure)
    caption = (
        "Where each place of the fixed image is to be found, magnified. Dots: one per draw, "
        "coloured by chain; cross and ellipse: mean and outline of the ellipsoid that holds 95 % of the draws; dashed: "
        "the way from its place in the fixed image (ring, where it is near enough to be seen)."
    )
    alt = "Places with their displaced positions: " + ", ".join(str(name) for name in predicted.place_names) + "."
    return Drawing("places", "Where the places go", caption, alt, uri)


def _place(axes: Axes, view: View, predicted: Predicted, k: int, axis: int, limits: tuple[float, float]) -> None:
    across, up = IN_PLANE[axis]
    point, u = np.asarray(predicted.place_points)[k], np.asarray(predicted.place_draws)[:, :, k]
    found = region(u.reshape(-1, 3))
    goes = point + found.mean
    half = max(ZOOM, 2 * float(found.semi_axes[0]))
    sides = [(float(goes[j] - half), float(goes[j] + half)) for j in (across, up)]
    plane = Plane(axis, float(goes[axis]), sides[0], sides[1], 2 * half / 160)
    panels.image_panel(axes, view.run.moving or view.run.background, plane, limits)
    stride = max(1, u.shape[0] * u.shape[1] // CLOUD)
    for chain, colour in zip(point + u, style.chain_colours(len(u)), strict=True):
        axes.plot(chain[::stride, across], chain[::stride, up], ".", ms=2.2, color=colour, alpha=0.9, mew=0)
    axes.plot([point[across], goes[across]], [point[up], goes[up]], color="white", lw=0.8, ls=(0, (2, 2)))
    axes.plot(point[across], point[up], "o", mfc="none", mec="white", ms=7, mew=1.3)
    axes.plot(goes[across], goes[up], "+", color="white", ms=6, mew=1.1)
    _ellipse(axes, goes[[across, up]], found.shape[np.ix_((across, up), (across, up))])
    axes.set(xlim=plane.horizontal, ylim=plane.vertical)


def _ellipse(axes: Axes, centre: np.ndarray, shape: np.ndarray) -> None:
    """Outline of an ellipsoid seen along an axis: the same matrix without that axis."""
    values, vectors = np.linalg.eigh(shape)
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    width, height = 2 * np.sqrt(np.clip(values[::-1], 0, None))
    axes.add_patch(Ellipse((centre[0], centre[1]), width, height, angle=angle, fill=False, ec="#f5d76e", lw=1.1))


def maps(view: View, predicted: Predicted) -> Drawing:
    """Sd, 95 % distance and probability of being far off, on three planes."""
    planes = view.planes[::-1]
    far = f"P(|u − ū| > {predicted.far_mm:g} mm)"
    rows: list[tuple[str, Callable[[Plane], np.ndarray]]] = [
        ("posterior sd, mm", view.spread),
        ("95 % within, mm", lambda plane: _scalar(view, plane, predicted.reach)),
        (far, lambda plane: _scalar(view, plane, predicted.far)),
    ]
    widths = [float(np.ptp(plane.horizontal)) for plane in planes]
    height = 0.93 * style.WIDTH * max(np.ptp(plane.vertical) for plane in planes) / sum(widths)
    with style.look():
        figure = style.new_figure(3 * height + 0.3)
        axes = figure.subplots(3, 3, width_ratios=widths)
        for row, (label, values) in zip(axes, rows, strict=True):
            pictures = [values(plane) for plane in planes]
            norm, cmap = (BANDS, "OrRd") if label == far else (panels.from_zero(*pictures), style.ERROR)
            place = {"ticks": BANDS.boundaries, "spacing": "uniform"} if label == far else {}
            for panel, plane, picture in zip(row, planes, pictures, strict=True):
                drawn = panels.field_panel(panel, picture, plane, norm, cmap)
                panels.outline(panel, view, plane)
            panels.colourbar(figure, drawn, list(row), label, **place)
        for panel, plane in zip(axes[0], planes, strict=True):
            panel.set_title(plane.title)
        uri = style.data_uri(figure)
    caption = (
        "Top: posterior standard deviation (root of the summed variances of the three components). Middle: distance "
        f"from its mean place within which a point lies with 95 %. Bottom: {far}, in bands. " + _numbers(predicted)
    )
    return Drawing("uncertainty", "How far to trust the displacement", caption, "Maps of the uncertainty, mm.", uri)


def _numbers(predicted: Predicted) -> str:
    """The content of the maps in a sentence."""
    share = float((np.asarray(predicted.far) > 1 - LEVEL).mean())
    median, worst = (number(float(x)) for x in (np.median(predicted.reach), np.max(predicted.reach)))
    return (
        f"The median node lies within {median} mm of its mean place with 95 %, the least certain one within {worst} "
        f"mm; at {percent(share)} of the nodes P(|u − ū| > {predicted.far_mm:g} mm) is above 5 %."
    )


def _scalar(view: View, plane: Plane, values: AnyArray) -> np.ndarray:
    return view.slice(plane).nodal(np.asarray(values, float)[:, None])[..., 0]
