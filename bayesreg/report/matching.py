"""How the moving image lies beside the fixed one: the pose by the headers and as found, and its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesreg.io.records import Predicted
from bayesreg.report import panels, style
from bayesreg.report.panels import View
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import fixed, part, place_text

NAMES = tuple(f"{what} {axis}" for what in ("shift along", "turn about") for axis in ("x (R)", "y (A)", "z (S)"))
UNITS = ("mm",) * 3 + ("°",) * 3


def notes(manifest: Mapping[str, Any]) -> list[str]:
    """What was found of pose and contrast before the search, a sentence each."""
    return list(part(manifest, "appraisal", "notes") or [])


def pose_picture(view: View) -> Drawing | None:
    """The border of the organ on the moving image by its header and by the pose; None where they are one."""
    run, pose = view.run, view.run.matching.pose
    if run.moving is None or run.fixed is None or pose.is_identity:
        return None
    by_header = pose.inverse.aligned(run.moving)
    columns = {"fixed f": run.fixed, "moving m by its header": by_header, "moving m by the pose": run.moving}
    planes, limits = view.planes[::-1], panels.grey_limits(run)
    with style.look():
        widths = [float(np.ptp(plane.horizontal)) for plane in planes]
        height = max(float(np.ptp(plane.vertical)) for plane in planes)
        figure = style.new_figure(len(columns) * 0.93 * style.WIDTH * height / sum(widths) + 0.3)
        axes = figure.subplots(len(columns), 3, width_ratios=widths, squeeze=False)
        for row, (name, image) in zip(axes, columns.items(), strict=True):
            for panel, plane in zip(row, planes, strict=True):
                panels.image_panel(panel, image, plane, limits)
                panels.outline(panel, view, plane, interfaces=False, colour=style.BORDER)
            row[0].set_ylabel(name)
        for panel, plane in zip(axes[0], planes, strict=True):
            panel.set_title(plane.title)
        uri = style.data_uri(figure)
    caption = (
        "The line is the border of the organ in the fixed image. Where the pose is right, it lies on the moving image "
        "as on the fixed one, but for the deformation."
    )
    alt = "The border of the organ on the fixed image, and on the moving one by its header and by the pose."
    return Drawing("alignment", "Where the moving image lies", caption, alt, uri)


def pose_table(predicted: Predicted) -> Table:
    """The rigid part of the displacement of the whole organ: mean, sd and 95 % interval of its six numbers."""
    motion = np.asarray(predicted.motion)
    draws = motion.reshape(-1, 6)
    low, high = np.quantile(draws, (0.025, 0.975), axis=0)
    rows = [
        [f"{NAMES[k]}, {UNITS[k]}", *(fixed(float(value), 3) for value in values)]
        for k, values in enumerate(zip(draws.mean(axis=0), draws.std(axis=0), low, high, strict=True))
    ]
    x, y, z = (float(coordinate) for coordinate in np.asarray(predicted.centre))
    caption = (
        f"Shift of the organ’s centre, {place_text((x, y, z))}, and turn about it, from the fixed image’s world to the "
        "moving one’s: the rigid motion nearest to each draw of the displacement, the pose that was found first "
        "included. Axes are those of the world (RAS)."
    )
    return Table("The rigid part of the displacement", caption, ["", "Mean", "Sd", "2.5 %", "97.5 %"], [("", rows)])
