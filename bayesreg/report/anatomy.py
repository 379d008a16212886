"""Figures on anatomy: the images before and after, and the displacement."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from bayesreg.image import Image
from bayesreg.io.records import Run
from bayesreg.report import panels, style
from bayesreg.report.panels import Row, View
from bayesreg.report.slices import Plane, sample
from bayesreg.report.style import Drawing
from bayesreg.report.verdict import number

CONVENTION = "Neurological convention: the left of the patient is on the left."


def before_and_after(run: Run, view: View, differences: tuple[float, float] | None) -> Drawing | None:
    """Draw the fixed, moving and warped images, and their differences, on three planes; None without images.

    If the images have unlike contrast, or a pose was needed, the figure shows the borders of the tissues on all images.
    `differences` is the result of `bayesreg.report.study.image_differences`.
    """
    if run.fixed is None or run.moving is None or run.warped is None:
        return None
    images, difference_images = _columns(run), _differences(run)
    with style.look():
        figure, axes = _grid(view, len(images) + len(difference_images))
        for row, plane in zip(axes, view.planes[::-1], strict=True):
            _draw_images(row, view, plane, images)
            row[0].set_ylabel(plane.title, color=style.MUTED)
        if difference_images:
            _draw_differences(figure, axes[:, len(images) :], view, list(difference_images.values()))
        for panel, title in zip(axes[0], [*images, *difference_images], strict=True):
            panel.set_title(title)
        uri = style.data_uri(figure)
    caption = " ".join(_explain(run, differences))
    return Drawing("registration", "Before and after", caption, "Fixed, moving and warped images on three planes.", uri)


def _columns(run: Run) -> dict[str, Image]:
    """Return the images to show, by their titles."""
    assert run.fixed is not None
    assert run.moving is not None
    assert run.warped is not None
    pose = run.matching.pose
    if pose.is_identity:
        return {"fixed f": run.fixed, "before: moving m": run.moving, "after: m(x + ū)": run.warped}
    by_header = pose.inverse.aligned(run.moving)
    return {
        "fixed f": run.fixed,
        "m by its header": by_header,
        "m by the pose": run.moving,
        "after: m(x + ū)": run.warped,
    }


def _differences(run: Run) -> dict[str, Image]:
    if not run.matching.one_contrast or run.moving is None or run.warped is None:
        return {}
    return {"before: m − f": run.moving, "after: m(x + ū) − f": run.warped}


def _draw_images(row: np.ndarray, view: View, plane: Plane, images: Mapping[str, Image]) -> None:
    run = view.run
    shared = panels.grey_limits(run) if run.matching.one_contrast else None
    plain = run.matching.one_contrast and run.matching.pose.is_identity
    fixed, moving, warped = panels.ignored(view, plane)
    masks = (fixed, moving, warped) if len(images) == 3 else (fixed, None, moving, warped)
    for panel, image, mask in zip(row, images.values(), masks, strict=False):
        panels.image_panel(panel, image, plane, shared or panels.range_of(image))
        if not plain:
            panels.label_lines(panel, run, plane)
        if mask is not None:
            panels.hatch(panel, plane, mask)


def _draw_differences(figure: Figure, axes: np.ndarray, view: View, images: list[Image]) -> None:
    planes = view.planes[::-1]
    pictures = [[_difference(view, image, plane) for image in images] for plane in planes]
    norm = panels.symmetric(np.concatenate([before.ravel() for before, *_ in pictures]))
    for row, plane, pair in zip(axes, planes, pictures, strict=True):
        fixed, *others = panels.ignored(view, plane)
        for panel, picture, mask in zip(row, pair, others, strict=True):
            drawn = panels.field_panel(panel, picture, plane, norm, style.SIGNED)
            panels.hatch(panel, plane, fixed | mask)
    panels.colourbar(figure, drawn, list(axes.ravel()), "intensity (scaled)", shrink=0.6)


def _difference(view: View, image: Image, plane: Plane) -> np.ndarray:
    """Return the difference between an image and the fixed one on a plane, NaN outside the mesh."""
    assert view.run.fixed is not None
    points = plane.points()
    return np.where(view.slice(plane).inside, sample(image, points) - sample(view.run.fixed, points), np.nan)


def _explain(run: Run, differences: tuple[float, float] | None) -> list[str]:
    sentences = ["Planes through the node of greatest displacement."]
    if differences is not None:
        before, after = differences
        sentences.append(
            f"The root mean square of the difference falls from {before:.3f} to {after:.3f} (scaled intensity)."
        )
    if not run.matching.one_contrast or not run.matching.pose.is_identity:
        sentences.append(
            "Lines: borders of the tissues in the fixed image, which should lie on those of the warped one."
        )
    if run.fixed_ignore is not None or run.moving_ignore is not None:
        sentences.append("What is hatched is ignored.")
    return [*sentences, CONVENTION]


def displacement(run: Run, view: View, reach: Float[np.ndarray, "nodes"]) -> Drawing:
    """Draw the posterior mean with arrows, the radius that holds 95 %, and the known error, on three planes."""
    rows = [
        Row("|ū|, mm", lambda plane: view.norm(plane, run.u_mean), style.MAGNITUDE),
        Row("95 % radius, mm", lambda plane: view.scalar(plane, reach), style.ERROR),
    ]
    if run.truth is not None:
        error = panels.error_of(run)
        rows.append(Row("|ū − u|, mm", lambda plane: view.norm(plane, error), style.ERROR))
    with style.look():
        figure, axes = panels.map_rows(view, rows)
        for panel, plane in zip(axes[0], view.planes[::-1], strict=True):
            panels.arrows(panel, view, plane, np.asarray(run.u_mean))
        uri = style.data_uri(figure)
    caption = (
        "Top: posterior mean; arrows at true length, from a fixed point to its moving point. Below: the radius about "
        "its mean place within which a point lies with 95 %, in the median node "
        f"{number(float(np.median(reach)))} mm, at most {number(float(np.max(reach)))} mm."
    )
    caption += " Bottom: error of the mean." if run.truth is not None else ""
    return Drawing("displacement", "Displacement and its uncertainty", caption, "Maps on three planes, mm.", uri)


def _grid(view: View, columns: int) -> tuple[Figure, np.ndarray]:
    """Make a figure with axial, coronal and sagittal rows at one scale."""
    heights = [float(np.ptp(plane.vertical)) for plane in view.planes[::-1]]
    width = max(np.ptp(plane.horizontal) for plane in view.planes)
    figure = style.new_figure(style.WIDTH / (columns + 0.35) * sum(heights) / width + 0.4)
    return figure, figure.subplots(3, columns, height_ratios=heights)
