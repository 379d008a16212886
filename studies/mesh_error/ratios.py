"""λ/μ allowing for the mesh: what simulated bodies (`studies.mesh_error.bodies`) tell of a registration on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesreg.mesh import TetMesh
from bayesreg.report import style
from bayesreg.report.estimands import parameter_groups
from bayesreg.report.tables import Table
from bayesreg.report.verdict import number
from bayesreg.tissues import label_of
from studies.mesh_error.recalibration import RANGE, Response, least_bodies, recalibrate, response

RATIO_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)


class Allowed(NamedTuple):
    """λ/μ of tissues as a run has it and allowing for its mesh.

    Attributes
    ----------
    names : list of str
        Solid tissues.
    true, found : (k, t) arrays
        λ/μ of the simulated bodies whose search has not failed.
    response : Response
    draws : (n, t) array
        Draws of the run's posterior.
    allowed : (m, t) array
        Draws of the body's own λ/μ.
    failed : int
        Bodies that are left out.
    """

    names: list[str]
    true: Float[np.ndarray, "bodies tissues"]
    found: Float[np.ndarray, "bodies tissues"]
    response: Response
    draws: Float[np.ndarray, "draws tissues"]
    allowed: Float[np.ndarray, "candidates tissues"]
    failed: int


def sound(bodies: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The bodies whose registration counts."""
    return [body for body in bodies if not body["failed"]]


def enough(bodies: Sequence[Mapping[str, Any]]) -> bool:
    """Whether there are so many sound bodies that they tell something."""
    return bool(bodies) and len(sound(bodies)) >= least_bodies(len(bodies[0]["true"]))


def allowing(mesh: TetMesh, posterior: xr.Dataset, bodies: Sequence[Mapping[str, Any]]) -> Allowed:
    """Draws of λ/μ as they are once it is allowed for what the mesh does to it.

    Raises
    ------
    InputError
        If too few of the bodies were registered well, or no draw has a λ/μ of every tissue.
    """
    names = list(bodies[0]["true"])
    counted = sound(bodies)
    ratios = [[[body[key][name] for name in names] for body in counted] for key in ("true", "found")]
    true, found = (np.array(rows, float).reshape(-1, len(names)) for rows in ratios)
    groups = {group.name: group.ratio.ravel() for group in parameter_groups(mesh, posterior)}
    draws = np.column_stack([groups[name] for name in names])
    draws = draws[np.isfinite(draws).all(axis=1) & (draws > 0).all(axis=1)]
    known = response(true, found)
    return Allowed(names, true, found, known, draws, recalibrate(known, draws), len(bodies) - len(counted))


def mesh_table(it: Allowed) -> Table:
    """Quantiles of λ/μ by tissue, as the posterior has it and allowing for the mesh, and of the prior."""
    rows = []
    for index, name in enumerate(it.names):
        for label, draws in (("on this mesh", it.draws), ("allowing for it", it.allowed)):
            levels = np.quantile(draws[:, index], RATIO_LEVELS)
            rows.append([f"{label_of(name)}, {label}", *map(number, levels)])
    low, high = np.log(RANGE)
    rows.append(["Prior", *(number(float(np.exp(low + level * (high - low)))) for level in RATIO_LEVELS)])
    header = ["", *(f"{level:.0%}".replace("%", " %") for level in RATIO_LEVELS)]
    caption = (
        f"{len(it.true)} bodies of known λ/μ, pushed on a finer mesh and registered on this one, tell how far what is "
        "found differs from the body’s own. Intervals of what is found on this mesh do not know of that. Those that "
        f"allow for it have a prior that is log-uniform from {RANGE[0]:g} to {RANGE[1]:g}: where they are as wide as "
        "it, this mesh says nothing of λ/μ." + _left_out(it.failed)
    )
    return Table("λ/μ, allowing for the mesh", caption, header, [("", rows)])


def _left_out(failed: int) -> str:
    if not failed:
        return ""
    which = "1 more is" if failed == 1 else f"{failed} more are"
    return f" {which} left out: the search for the mode failed there."


def draw_ratios(it: Allowed) -> Figure:
    """λ/μ that is found of the bodies over their own (dots), with this run's and what it stands for.

    Dashed: what a mesh without error would find; line: what this one finds on average, the other tissues as in the run.
    Band: the central 95 % interval of this run; bar at the foot: the interval of the body's own λ/μ, with its median.
    """
    with style.look():
        figure = style.new_figure(3.4)
        for index, panel in enumerate(figure.subplots(1, len(it.names), squeeze=False)[0]):
            _panel(panel, it, index)
    return figure


def _panel(panel: Axes, it: Allowed, index: int) -> None:
    low, high = np.quantile(it.draws[:, index], (0.025, 0.975))
    found = it.found[:, index]
    reach = (0.8 * RANGE[0], 1.25 * RANGE[1])
    heights = (min(reach[0], 0.8 * found.min(), 0.8 * low), max(reach[1], 1.25 * found.max(), 1.25 * high))
    foot = heights[0] * (heights[1] / heights[0]) ** 0.03
    panel.axhspan(low, high, color=style.ACCENT, alpha=0.2, linewidth=0)
    panel.plot(reach, reach, "--", color=style.MUTED, linewidth=1)
    grid = np.geomspace(*RANGE, 100)
    others = np.tile(1 / np.median(it.allowed, axis=0), (len(grid), 1))
    others[:, index] = 1 / grid
    panel.plot(grid, np.exp(-it.response(others)[:, index]), color=style.INK, linewidth=1)
    panel.scatter(it.true[:, index], found, s=16, color=style.INK, zorder=3)
    own_low, own, own_high = np.quantile(it.allowed[:, index], (0.025, 0.5, 0.975))
    panel.plot([own_low, own_high], [foot] * 2, color=style.ACCENT, linewidth=4, solid_capstyle="butt")
    panel.plot([own], [foot], "o", color="white", markeredgecolor=style.ACCENT, markersize=6, zorder=4)
    panel.set(xscale="log", yscale="log", xlim=reach, ylim=heights)
    panel.set(title=style.literal(label_of(it.names[index])), xlabel="λ/μ of the body")
    if index == 0:
        panel.set_ylabel("λ/μ found")
