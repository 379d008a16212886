"""The report on a measured surface: heights of the points over the surface, before and after, as a table and a map."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bayesreg.model.observations.section import Arrays, ReportFigure, ReportTable

# A sentence on the first page warns where the median distance is more than this multiple of sd, or where a greater
# share of points is wrong than this.
FAR, MANY = 2.0, 0.2


def surface_table(name: str, summary: Arrays) -> ReportTable:
    """Make the table of the distances of the points from the surface, at rest and at the posterior mean."""
    right = ~_are_wrong(summary)
    rows = []
    for label, key in (("At rest", "height_at_rest"), ("At the posterior mean", "height")):
        distance = np.abs(summary[key][right])
        rows.append([label, *(float(np.quantile(distance, level)) for level in (0.5, 0.95)), float(distance.max())])
    caption = (
        f"Distance of the points from the surface, mm. {(~right).sum()} of {len(right)} points are probably wrong and "
        f"left out here; they count little. The sd of the errors is {float(summary['sd']):.2g} mm. The residuals of "
        f"neighbours are alike, so that all points count as {float(summary['independent']):.0f} independent ones."
    )
    return ReportTable(f"Points on the {name}", caption, ["", "Median", "95 %", "Greatest"], rows)


def height_figure(name: str, summary: Arrays) -> ReportFigure:
    """Make the map of the heights of the points over the surface, at rest and at the posterior mean."""
    caption = (
        "The measured points, seen along the direction in which they are flattest. Colour: how high each lies over the "
        "surface of the organ (red: outside). Left: before the organ has moved; right: at the posterior mean. Rings: "
        "points that are probably wrong. Patches of one colour on the right are what the model cannot follow."
    )
    alt = f"Heights of {len(summary['points'])} points over the {name}, at rest and at the posterior mean."
    return ReportFigure(f"surface-{name}", f"Heights over the {name}", caption, alt, 4.2, partial(_draw, dict(summary)))


def describe_far_surface(name: str, summary: Arrays) -> list[str]:
    """Return a sentence if many points do not lie on the moved surface; none if they do."""
    wrong = _are_wrong(summary)
    median = float(np.median(np.abs(summary["height"])))
    if wrong.mean() <= MANY and median <= FAR * float(summary["sd"]):
        return []
    return [
        f"{name}: {wrong.sum()} of {len(wrong)} points are probably wrong, and the median distance from the moved "
        f"surface is {median:.2g} mm; are they in the space of the moving image (world RAS, mm), and of this surface?"
    ]


def _are_wrong(summary: Arrays) -> Bool[np.ndarray, "k"]:
    return np.asarray(summary.get("wrong", np.zeros(len(summary["points"])))) > 0.5


def _draw(summary: Arrays, figure: Any, style: Any) -> None:
    across, wrong = _view(summary["points"]), _are_wrong(summary)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for panel, key, title in zip(axes, ("height_at_rest", "height"), ("at rest", "at the posterior mean"), strict=True):
        height = summary[key]
        bound = float(np.quantile(np.abs(height[~wrong]), 0.98)) or 1.0
        how = {"c": height[~wrong], "cmap": style.SIGNED, "vmin": -bound, "vmax": bound, "s": 8, "lw": 0}
        drawn = panel.scatter(*across[~wrong].T, **how)
        panel.scatter(*across[wrong].T, s=14, facecolors="none", edgecolors=style.MUTED, lw=0.7)
        panel.set(aspect="equal", title=title, xlabel="mm")
        figure.colorbar(drawn, ax=panel, label="height over the surface, mm", shrink=0.8)
    axes[0].set_ylabel("mm")


def _view(points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 2"]:
    """Return the coordinates of points in the plane along which they spread most, mm."""
    centred = points - np.median(points, axis=0)
    return centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T
