"""Single panels: an image, a field, a label map or a mesh cut on one plane, with directions and a scale bar."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize, to_rgb
from matplotlib.figure import Figure, FigureBase
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.io.records import Run
from bayesreg.mesh import TetMesh
from bayesreg.report import style
from bayesreg.report.metrics import divergence
from bayesreg.report.slices import DIRECTIONS, IN_PLANE, MeshSlice, Plane, planes_through, sample
from bayesreg.tissues import colours_of, label_of
from bayesreg.types import AnyArray

BAR_LENGTHS = (5, 10, 20, 50, 100)
MAX_VOXELS = 200_000


@dataclass(frozen=True, eq=False)
class View:
    """The three planes on which a run is shown; `main` shows most of the displacement.

    Attributes
    ----------
    run : Run
    planes : tuple of Plane
        Sagittal, coronal, axial.
    """

    run: Run
    planes: tuple[Plane, Plane, Plane]
    _slices: dict[Plane, MeshSlice] = field(default_factory=dict)

    @classmethod
    def of(cls, run: Run, point: AnyArray | None = None) -> View:
        """Make planes through a point (mm), or through the node of greatest (if known, true) displacement."""
        u = true_or_mean_displacement(run)
        return cls(
            run, planes_through(run.mesh, run.mesh.points[(u**2).sum(axis=1).argmax()] if point is None else point)
        )

    def view_of(self, run: Run) -> View:
        """Make a view of another run on these planes."""
        return View(run, self.planes)

    @cached_property
    def main(self) -> Plane:
        """The plane with the greatest integral of |u|² over its section."""
        u = true_or_mean_displacement(self.run)
        return max(self.planes, key=lambda plane: np.nansum(self.slice(plane).nodal(u) ** 2) * plane.spacing**2)

    def slice(self, plane: Plane) -> MeshSlice:
        """Return the section of the mesh on a plane."""
        if plane not in self._slices:
            self._slices[plane] = MeshSlice(self.run.mesh, plane)
        return self._slices[plane]

    def norm(self, plane: Plane, vectors: AnyArray) -> np.ndarray:
        """Return the length of a nodal vector field on a plane."""
        return np.linalg.norm(self.slice(plane).nodal(vectors), axis=-1)

    def scalar(self, plane: Plane, values: AnyArray) -> np.ndarray:
        """Return a nodal scalar field on a plane."""
        return self.slice(plane).nodal(np.asarray(values, float)[:, None])[..., 0]

    def divergence(self, plane: Plane, u: AnyArray) -> np.ndarray:
        """Return div u on a plane."""
        return self.slice(plane).cellwise(divergence(self.run.mesh, u))


def error_of(run: Run) -> np.ndarray:
    """Compute ū − u_true at every node, (n, 3), mm."""
    if run.truth is None:
        raise ValueError("the error of a run is known only where the truth is")
    return np.asarray(run.u_mean) - np.asarray(run.truth.u)


class Row(NamedTuple):
    """A row of maps, one for each plane, on one colour scale.

    Attributes
    ----------
    label : str
        The label of its colour bar.
    picture : function
        Maps a plane to its pixels.
    cmap : str
    norm : Normalize or None
        None means a range from 0 to the greatest value of the row.
    """

    label: str
    picture: Callable[[Plane], np.ndarray]
    cmap: str
    norm: Normalize | None = None


def map_rows(view: View, rows: Sequence[Row]) -> tuple[Figure, np.ndarray]:
    """Make a figure of rows of maps on the axial, coronal and sagittal planes, and return its axes, too."""
    planes = view.planes[::-1]
    widths = [float(np.ptp(plane.horizontal)) for plane in planes]
    height = 0.93 * style.WIDTH * max(np.ptp(plane.vertical) for plane in planes) / sum(widths)
    figure = style.new_figure(len(rows) * height + 0.3)
    axes = figure.subplots(len(rows), 3, width_ratios=widths, squeeze=False)
    for panels, row in zip(axes, rows, strict=True):
        pictures = [row.picture(plane) for plane in planes]
        norm = row.norm or from_zero(*pictures)
        for panel, plane, picture in zip(panels, planes, pictures, strict=True):
            drawn = field_panel(panel, picture, plane, norm, row.cmap)
            outline(panel, view, plane)
        colourbar(figure, drawn, list(panels), row.label)
    for panel, plane in zip(axes[0], planes, strict=True):
        panel.set_title(plane.title)
    return figure, axes


def true_or_mean_displacement(run: Run) -> np.ndarray:
    """Return the true displacement if it is known, else the posterior mean; (n, 3), mm."""
    return np.asarray(run.u_mean if run.truth is None else run.truth.u, float)


def image_panel(axes: Axes, image: Image, plane: Plane, limits: tuple[float, float]) -> AxesImage:
    """Draw an image on a plane; black beyond its grid."""
    picture = sample(image, plane.points(), outside=limits[0])
    return field_panel(axes, picture, plane, Normalize(*limits), style.GREY, dark=True)


def field_panel(
    axes: Axes, picture: np.ndarray, plane: Plane, norm: Normalize, cmap: str, dark: bool = False
) -> AxesImage:
    """Draw values, or colours, on the pixels of a plane; white where they are not finite."""
    drawn = axes.imshow(picture, origin="lower", extent=plane.extent, cmap=cmap, norm=norm, interpolation="auto")
    _frame(axes, plane, dark)
    return drawn


def outline(axes: Axes, view: View, plane: Plane, interfaces: bool = True, colour: str = style.INK) -> None:
    """Draw the border of the mesh and, by default, the interfaces between its tissues."""
    tissue = np.nan_to_num(view.slice(plane).cellwise(view.run.mesh.tissue), nan=-1.0)
    x, y = np.linspace(*plane.horizontal, tissue.shape[1]), np.linspace(*plane.vertical, tissue.shape[0])
    for label in np.unique(tissue) if interfaces else [-1.0]:
        # A blur of one pixel hides the staircase of the pixels.
        level = ndimage.gaussian_filter((tissue == label).astype(float), 1.0)
        width, alpha = (0.8, 0.9) if label < 0 else (0.35, 0.5)
        axes.contour(x, y, level, [0.5], colors=colour, linewidths=width, alpha=alpha)


def ignored(view: View, plane: Plane) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the ignored pixels of a plane: in the fixed image, in the moving image, and in the warped image.

    Returns
    -------
    three bool arrays
        Pixels of the plane.
    """
    run, points = view.run, plane.points()
    displaced_points = points + np.nan_to_num(view.slice(plane).nodal(run.u_mean))
    masks = (run.fixed_ignore, points), (run.moving_ignore, points), (run.moving_ignore, displaced_points)
    nothing = np.zeros(points.shape[:-1], bool)
    fixed, moving, warped = (nothing if mask is None else mask.nearest(places) != 0 for mask, places in masks)
    return fixed, moving, warped


def hatch(axes: Axes, plane: Plane, mask: np.ndarray) -> None:
    """Hatch some pixels of a plane, and draw their border."""
    if not mask.any():
        return
    x, y = np.linspace(*plane.horizontal, mask.shape[1]), np.linspace(*plane.vertical, mask.shape[0])
    drawn = axes.contourf(x, y, mask.astype(float), [0.5, 1.5], colors="none", hatches=["/////"])
    drawn.set_edgecolor(style.BORDER)
    drawn.set_linewidth(0.0)
    axes.contour(x, y, mask.astype(float), [0.5], colors=style.BORDER, linewidths=0.6)


def label_panel(axes: Axes, run: Run, plane: Plane) -> None:
    """Draw the tissue labels and the skull."""
    points = plane.points()
    palette = np.array([to_rgb("white"), *map(to_rgb, colours_of(run.mesh.names))])
    labels = sample(run.tissue, points, order=0, outside=0.0).astype(int)
    picture = palette[np.clip(labels, 0, len(run.mesh.names))]
    if run.skull is not None:
        forbidden = sample(run.skull, points, order=0, outside=1.0) != 0
        picture[forbidden] = to_rgb(style.SKULL)
    field_panel(axes, picture, plane, Normalize(0, 1), style.GREY, dark=run.skull is not None)


def label_lines(axes: Axes, run: Run, plane: Plane) -> None:
    """Draw the borders of the tissue labels."""
    labels = sample(run.tissue, plane.points(), order=0, outside=0.0)
    x, y = np.linspace(*plane.horizontal, labels.shape[1]), np.linspace(*plane.vertical, labels.shape[0])
    for value in np.unique(labels)[1:]:
        level = ndimage.gaussian_filter((labels == value).astype(float), 1.0)
        axes.contour(x, y, level, [0.5], colors=style.BORDER, linewidths=0.4)


def mesh_panel(axes: Axes, mesh: TetMesh, plane: Plane) -> None:
    """Draw the section of the mesh, coloured by tissue, with white lines between its tetrahedra."""
    fine = plane._replace(spacing=plane.spacing / 3)
    cell = np.nan_to_num(MeshSlice(mesh, fine).cellwise(np.arange(len(mesh.cells))), nan=-1.0).astype(int)
    palette = np.array([*map(to_rgb, colours_of(mesh.names)), to_rgb("white")])
    picture = palette[np.where(cell < 0, -1, mesh.tissue[cell])]
    picture[:-1][cell[1:] != cell[:-1]] = 1.0
    picture[:, :-1][cell[:, 1:] != cell[:, :-1]] = 1.0
    field_panel(axes, picture, plane, Normalize(0, 1), style.GREY)


def arrows(axes: Axes, view: View, plane: Plane, u: np.ndarray) -> None:
    """Draw the in-plane displacement at true length, every few millimetres."""
    picture = view.slice(plane).nodal(u)
    stride = max(1, picture.shape[1] // 16)
    slices = (slice(stride // 2, None, stride),) * 2
    across, up = IN_PLANE[plane.axis]
    points, displacement = plane.points()[slices], picture[slices]
    axes.quiver(
        *(points[..., across], points[..., up], displacement[..., across], displacement[..., up]),
        angles="xy",
        scale_units="xy",
        scale=1,
        color="white",
        width=0.005,
        headwidth=4,
        headlength=4.5,
    )


def symmetric(values: np.ndarray, quantile: float = 0.995) -> Normalize:
    """Return a colour range −a … a that holds nearly all finite values."""
    bound = _bound(np.abs(values), quantile)
    return Normalize(-bound, bound)


def from_zero(*values: np.ndarray, quantile: float = 0.998) -> Normalize:
    """Return a colour range 0 … a that holds nearly all finite values of all pictures."""
    return Normalize(0, max(_bound(value, quantile) for value in values))


def _bound(values: np.ndarray, quantile: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, quantile)) or 1e-9 if finite.size else 1.0


def grey_limits(run: Run) -> tuple[float, float]:
    """Return one grey scale for the images of a run: the range of the background, without its extremes."""
    return range_of(run.background)


def range_of(image: Image) -> tuple[float, float]:
    """Return the range of an image, without its extremes, from an even sample of its voxels."""
    values = np.ravel(image.voxels)
    low, high = np.quantile(values[:: max(1, values.size // MAX_VOXELS)].astype(float), (0.005, 0.998))
    return float(low), float(max(high, low + 1e-9))


def colourbar(figure: FigureBase, drawn: ScalarMappable, axes: Axes | Sequence[Axes], label: str, **place: Any) -> None:
    """Draw a narrow colour bar with its unit."""
    settings: dict[str, Any] = {"fraction": 0.05, "pad": 0.02, "aspect": 28, "shrink": 0.94} | place
    bar = figure.colorbar(drawn, ax=axes, **settings)
    bar.outline.set_visible(False)
    bar.ax.tick_params(length=2, labelsize=7)
    if isinstance(drawn.norm, LogNorm):
        bar.locator, bar.minorlocator = LogLocator(subs=(1, 2, 5)), NullLocator()
        bar.formatter = FuncFormatter(lambda value, _: f"{value:.3g}")
    else:
        bar.locator = MaxNLocator(5)
    bar.update_ticks()
    bar.set_label(label, fontsize=8)


def tissue_legend(names: Sequence[str], skull: bool) -> list[Patch]:
    """Make legend handles for the tissues and the skull."""
    handles = [
        Patch(color=colour, label=style.literal(label_of(name)))
        for name, colour in zip(names, colours_of(names), strict=True)
    ]
    return handles + ([Patch(color=style.SKULL, label="skull (forbidden)")] if skull else [])


def _frame(axes: Axes, plane: Plane, dark: bool) -> None:
    axes.set(xlim=plane.horizontal, ylim=plane.vertical, aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)
    colour = "#e4e7eb" if dark else style.MUTED
    across, up = IN_PLANE[plane.axis]
    places = {(0.015, 0.5): DIRECTIONS[across][0], (0.985, 0.5): DIRECTIONS[across][1]}
    places |= {(0.5, 0.015): DIRECTIONS[up][0], (0.5, 0.985): DIRECTIONS[up][1]}
    for (x, y), letter in places.items():
        aligned: dict[str, Any] = {"ha": _side(x, "left", "right"), "va": _side(y, "bottom", "top")}
        axes.text(x, y, letter, transform=axes.transAxes, fontsize=7, color=colour, **aligned)
    _scale_bar(axes, plane, colour)


def _side(position: float, low: str, high: str) -> str:
    return low if position < 0.1 else high if position > 0.9 else "center"


def _scale_bar(axes: Axes, plane: Plane, colour: str) -> None:
    width, height = np.ptp(plane.horizontal), np.ptp(plane.vertical)
    length = max((size for size in BAR_LENGTHS if size <= width / 4), default=BAR_LENGTHS[0])
    left, bottom = plane.horizontal[0] + 0.03 * width, plane.vertical[0] + 0.03 * height
    axes.plot([left, left + length], [bottom, bottom], color=colour, lw=1.2, solid_capstyle="butt")
    axes.text(left + length / 2, bottom + 0.012 * height, f"{length} mm", fontsize=6, color=colour, ha="center")
