"""Chains that disagree: the differences between their groups, and the result of each group."""

from __future__ import annotations

import numpy as np

from bayesreg.report import panels, style
from bayesreg.report.grouping import SEPARATION_SD, Grouping, group_means
from bayesreg.report.page import Sentences
from bayesreg.report.panels import View
from bayesreg.report.places import regions
from bayesreg.report.study import Study
from bayesreg.report.style import Drawing
from bayesreg.report.verdict import number, place_text

MOST_SHOWN = 4


def disagree(study: Study) -> bool:
    """Check whether the chains of a run lie in several groups."""
    return study.groups.groups > 1


def explain(study: Study) -> Sentences:
    """Explain which groups there are in a run, and their possible meaning."""
    return Sentences("", explanation(study.groups))


def explanation(groups: Grouping) -> list[str]:
    """Explain which groups there are, and their possible meaning."""
    listed = "; ".join(f"group {k + 1}: {_chain_list(groups.chains(k))}" for k in range(groups.groups))
    sentence = (
        f"The chains lie in {groups.groups} groups ({listed}), {SEPARATION_SD:g} or more standard deviations apart."
    )
    moving = np.flatnonzero(groups.drifting)
    if len(moving):
        verb = "is" if len(moving) == 1 else "are"
        return [sentence, f"But {_chain_list(moving)} {verb} still moving: they have not arrived yet. Run longer."]
    return [
        sentence,
        "Each chain is steady in its place, which speaks for several modes. How many chains lie in a mode says nothing "
        "of its probability; the mean over all chains may be a displacement that no mode has.",
    ]


def _chain_list(chains: np.ndarray) -> str:
    numbers = [str(int(chain) + 1) for chain in chains]
    return ("chain " if len(numbers) == 1 else "chains ") + ", ".join(numbers)


def modes(study: Study) -> Drawing:
    """Draw |ū| of each group side by side at the greatest difference, and the distances between the groups."""
    groups, mesh = study.groups, study.mesh
    means = group_means(study.predicted.chain_mean, groups)
    distances = np.linalg.norm(means[:, None] - means[None], axis=-1).max(axis=(0, 1))
    where = mesh.points[distances.argmax()]
    view = View.of(study.run, where)
    plane, shown = view.main, min(groups.groups, MOST_SHOWN)
    pictures = [view.norm(plane, mean) for mean in means[:shown]]
    norm = panels.from_zero(*pictures)
    with style.look():
        figure = style.new_figure(style.WIDTH / (shown + 1.6) * np.ptp(plane.vertical) / np.ptp(plane.horizontal) + 0.5)
        *axes, last = figure.subplots(1, shown + 1)
        for k, (panel, picture) in enumerate(zip(axes, pictures, strict=True)):
            drawn = panels.field_panel(panel, picture, plane, norm, style.MAGNITUDE)
            panel.set_title(f"|ū| of group {k + 1} ({_chain_list(groups.chains(k))})")
        panels.colourbar(figure, drawn, axes, "mm", location="bottom", shrink=0.6, aspect=40)
        picture = view.scalar(plane, distances)
        drawn = panels.field_panel(last, picture, plane, panels.from_zero(picture), style.ERROR)
        panels.colourbar(figure, drawn, last, "mm", location="bottom")
        last.set_title("greatest distance between them")
        for panel in (*axes, last):
            panels.outline(panel, view, plane)
        uri = style.data_uri(figure)
    more = "" if shown == groups.groups else f" The first {shown} of {groups.groups} groups are shown."
    caption = (
        f"Plane: {plane.title}, near the node where the groups lie farthest apart: {number(distances.max())} mm at "
        f"{place_text(where)}, {regions(mesh, where[None])[0]}.{more}"
    )
    return Drawing("modes", "One picture for each group of chains", caption, f"|ū| of {shown} groups of chains.", uri)
