"""The uncertainty of the displacement at places: regions that hold 95 % of the draws."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from bayesreg.report import panels, style
from bayesreg.report.places import regions
from bayesreg.report.slices import IN_PLANE, NAMES, Plane
from bayesreg.report.study import Study
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import decimal_text, percent, place_text
from bayesreg.types import AnyArray

LEVEL = 0.95
COLUMNS = 6
# Half of the width of a magnified panel, mm.
ZOOM = 4.0
CLOUD = 300
HEADER = ["", "Place (x, y, z)", "Where", "Shift x, y, z, mm", "Length, mm", "95 % semi-axes, mm"]


class Region(NamedTuple):
    """The ellipsoid around the mean of draws, with the shape of their covariance, that holds 95 % of them.

    Attributes
    ----------
    mean : (3,) array
        mm.
    shape : (3, 3) array
        The semi-axes are the square roots of its eigenvalues, mm².
    """

    mean: Float[np.ndarray, "3"]
    shape: Float[np.ndarray, "3 3"]

    @property
    def semi_axes(self) -> Float[np.ndarray, "3"]:
        """The lengths of the semi-axes in decreasing order, mm."""
        return np.sqrt(np.clip(np.linalg.eigvalsh(self.shape), 0, None))[::-1]


def region(draws: Float[AnyArray, "draws 3"]) -> Region:
    """Compute the 95 % region of draws; its size is a quantile of the draws, not of the Normal distribution."""
    draws = np.asarray(draws, float)
    mean, covariance = draws.mean(axis=0), np.cov(draws, rowvar=False) if len(draws) > 1 else np.zeros((3, 3))
    offset = draws - mean
    squared = np.einsum("di,ij,dj->d", offset, np.linalg.pinv(covariance, hermitian=True), offset)
    return Region(mean, covariance * np.quantile(squared, LEVEL))


class Place(NamedTuple):
    """A place of the fixed image: its name, its position (mm), and draws of its displacement, (chains, draws, 3)."""

    name: str
    point: np.ndarray
    draws: np.ndarray

    @property
    def region(self) -> Region:
        """The region of all draws of the displacement."""
        return region(self.draws.reshape(-1, 3))


def places_of(study: Study) -> list[Place]:
    """List the places of a run."""
    predicted = study.predicted
    draws, points = np.moveaxis(np.asarray(predicted.place_draws), 2, 0), np.asarray(predicted.place_points, float)
    return [Place(str(name), *rest) for name, *rest in zip(predicted.place_names, points, draws, strict=True)]


def place_table(study: Study) -> Table:
    """Make a table of the displacement and 95 % region of every place."""
    words, far = regions(study.mesh, study.predicted.place_points), float(study.predicted.far_mm)
    rows = [_place_row(place, where, far) for place, where in zip(places_of(study), words, strict=True)]
    caption = (
        "Mean displacement (to the right, to the front, upwards), and the ellipsoid that holds 95 % of the draws; "
        "last, the share of draws further from the mean. The setting report.places names places; else some are chosen."
    )
    return Table("Places", caption, [*HEADER, f"P(> {far:g} mm)"], [("", rows)])


def _place_row(place: Place, where: str, far: float) -> list[str]:
    ellipsoid = place.region
    beyond = (np.linalg.norm(place.draws.reshape(-1, 3) - ellipsoid.mean, axis=1) > far).mean()
    shift = ", ".join(decimal_text(x, 1) for x in ellipsoid.mean)
    axes = " × ".join(decimal_text(x) for x in ellipsoid.semi_axes)
    return [
        place.name,
        place_text(place.point),
        where,
        shift,
        decimal_text(float(np.linalg.norm(ellipsoid.mean)), 1),
        axes,
        percent(beyond),
    ]


def places(study: Study) -> Drawing | None:
    """Draw the draws and the 95 % region of each place on the moving image, a column for each; None without images."""
    if study.run.moving is None:
        return None
    shown = places_of(study)
    bands, columns = -(-len(shown) // COLUMNS), min(max(len(shown), 4), COLUMNS)
    with style.look():
        figure = style.new_figure(bands * (3 * style.WIDTH / columns + 0.35))
        axes = figure.subplots(3 * bands, columns, squeeze=False)
        limits = panels.grey_limits(study.run)
        for k, place in enumerate(shown):
            band, column = divmod(k, COLUMNS)
            for row, axis in enumerate((2, 1, 0)):
                _draw_place(axes[3 * band + row, column], study, place, axis, limits)
                axes[3 * band + row, 0].set_ylabel(NAMES[axis], fontsize=8, color=style.MUTED)
            axes[3 * band, column].set_title(style.literal(place.name), fontsize=8)
        for panel in axes.ravel():
            if not panel.has_data():
                panel.remove()
        uri = style.data_uri(figure)
    caption = (
        "Dots: one for each draw, coloured by chain; cross and ellipse: mean and 95 % ellipsoid; dashed: the way from "
        "the place in the fixed image (ring)."
    )
    alt = "Places with their displaced positions: " + ", ".join(place.name for place in shown) + "."
    return Drawing("places", "Where each place goes, on the moving image", caption, alt, uri)


def _draw_place(axes: Axes, study: Study, place: Place, axis: int, limits: tuple[float, float]) -> None:
    across, up = IN_PLANE[axis]
    ellipsoid, point = place.region, place.point
    goes = point + ellipsoid.mean
    half = max(ZOOM, 2 * float(ellipsoid.semi_axes[0]))
    sides = [(float(goes[j] - half), float(goes[j] + half)) for j in (across, up)]
    plane = Plane(axis, float(goes[axis]), sides[0], sides[1], 2 * half / 160)
    assert study.run.moving is not None
    panels.image_panel(axes, study.run.moving, plane, limits)
    stride = max(1, place.draws.shape[0] * place.draws.shape[1] // CLOUD)
    for chain, colour in zip(point + place.draws, style.chain_colours(len(place.draws)), strict=True):
        axes.plot(chain[::stride, across], chain[::stride, up], ".", ms=2.2, color=colour, alpha=0.9, mew=0)
    axes.plot([point[across], goes[across]], [point[up], goes[up]], color="white", lw=0.8, ls=(0, (2, 2)))
    axes.plot(point[across], point[up], "o", mfc="none", mec="white", ms=7, mew=1.3)
    axes.plot(goes[across], goes[up], "+", color="white", ms=6, mew=1.1)
    _draw_ellipse(axes, goes[[across, up]], ellipsoid.shape[np.ix_((across, up), (across, up))])
    axes.set(xlim=plane.horizontal, ylim=plane.vertical)


def _draw_ellipse(axes: Axes, centre: np.ndarray, shape: np.ndarray) -> None:
    """Draw the outline of an ellipsoid seen along an axis: the same matrix without that axis."""
    values, vectors = np.linalg.eigh(shape)
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    width, height = 2 * np.sqrt(np.clip(values[::-1], 0, None))
    axes.add_patch(Ellipse((centre[0], centre[1]), width, height, angle=angle, fill=False, ec="#f5d76e", lw=1.1))
