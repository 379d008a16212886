"""The fixed image and another one in one picture: checkerboards, and pairs for a slider between the two."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.colors import Normalize

from bayesreg.report import panels, style
from bayesreg.report.anatomy import CONVENTION, note
from bayesreg.report.panels import View
from bayesreg.report.slices import sample
from bayesreg.report.style import Drawing

# Of a checkerboard, from left to right.
SQUARES = 9


class Swipe(NamedTuple):
    """Two pictures of one plane."""

    title: str
    fixed: str
    warped: str


def checkerboard(view: View) -> Drawing | None:
    """Squares of the fixed image in turn with the moving one, before and after, and the borders of tissues."""
    run = view.run
    if run.fixed is None or run.moving is None or run.warped is None:
        return None
    other = {"before: fixed and moving": run.moving, "after: fixed and warped": run.warped}
    fixed_limits = panels.range_of(run.fixed)
    limits = fixed_limits if run.matching.one_contrast else panels.range_of(run.moving)
    with style.look():
        planes = view.planes[::-1]
        figure = style.new_figure(0.5 * style.WIDTH * 1.35)
        axes = figure.subplots(2, len(planes))
        for row, (title, image) in zip(axes, other.items(), strict=True):
            for panel, plane in zip(row, planes, strict=True):
                points = plane.points()
                fixed, moved = (
                    (sample(one, points, outside=low) - low) / (high - low)
                    for one, (low, high) in ((run.fixed, fixed_limits), (image, limits))
                )
                side = np.ptp(plane.horizontal) / SQUARES
                across, up = (points[..., axis] // side for axis in panels.IN_PLANE[plane.axis])
                picture = np.where((across + up) % 2 == 0, fixed, moved)
                panels.field_panel(panel, picture, plane, Normalize(0, 1), style.GREY, dark=True)
                panels.label_lines(panel, run, plane)
            note(row[0], title)
        for panel, plane in zip(axes[0], planes, strict=True):
            panel.set_title(plane.title)
        uri = style.data_uri(figure)
    caption = (
        "Squares of the fixed image in turn with those of the other one: where they fit, edges run on from square to "
        f"square. The lines are the borders of the tissues in the fixed image. {CONVENTION}"
    )
    alt = "Checkerboards of the fixed image with the moving one, before and after registration."
    return Drawing("checkerboard", "Checkerboard", caption, alt, uri)


def swipes(view: View) -> list[Swipe]:
    """The fixed image and the warped one on each plane, for a slider between the two; empty without images."""
    run = view.run
    if run.fixed is None or run.moving is None or run.warped is None:
        return []
    limits = panels.range_of(run.fixed)
    other = limits if run.matching.one_contrast else panels.range_of(run.moving)
    found = []
    for plane in view.planes[::-1]:
        points = plane.points()
        pictures = [
            style.grey_uri(np.clip((sample(image, points, outside=low) - low) / (high - low), 0, 1))
            for image, (low, high) in ((run.fixed, limits), (run.warped, other))
        ]
        found.append(Swipe(plane.title, *pictures))
    return found
