"""λ/μ corrected for the error of the mesh, which simulated bodies show (`studies.mesh_error.bodies`)."""

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


class MeshCorrection(NamedTuple):
    """λ/μ of tissues as a run found it, and corrected for its mesh.

    Attributes
    ----------
    names : list of str
        The names of the solid tissues.
    true, estimated : (k, t) arrays
        λ/μ of the simulated bodies whose registration did not fail, and the estimates of these registrations.
    response : Response
    draws : (n, t) array
        Draws of the run's posterior.
    corrected : (m, t) array
        Draws of λ/μ corrected for the mesh.
    failed : int
        The number of bodies whose registration failed.
    """

    names: list[str]
    true: Float[np.ndarray, "bodies tissues"]
    estimated: Float[np.ndarray, "bodies tissues"]
    response: Response
    draws: Float[np.ndarray, "draws tissues"]
    corrected: Float[np.ndarray, "candidates tissues"]
    failed: int


def sound(bodies: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The bodies whose registration did not fail."""
    return [body for body in bodies if not body["failed"]]


def enough(bodies: Sequence[Mapping[str, Any]]) -> bool:
    """Whether enough registrations succeeded for a response curve."""
    return bool(bodies) and len(sound(bodies)) >= least_bodies(len(bodies[0]["true"]))


def correct_for_mesh(mesh: TetMesh, posterior: xr.Dataset, bodies: Sequence[Mapping[str, Any]]) -> MeshCorrection:
    """Correct the draws of λ/μ for the error of the mesh.

    Raises
    ------
    InputError
        If too few registrations succeeded, or no draw has a λ/μ of every tissue.
    """
    names = list(bodies[0]["true"])
    counted = sound(bodies)
    ratios = [[[body[key][name] for name in names] for body in counted] for key in ("true", "found")]
    true, estimated = (np.array(rows, float).reshape(-1, len(names)) for rows in ratios)
    groups = {group.name: group.ratio.ravel() for group in parameter_groups(mesh, posterior)}
    draws = np.column_stack([groups[name] for name in names])
    draws = draws[np.isfinite(draws).all(axis=1) & (draws > 0).all(axis=1)]
    curve = response(true, estimated)
    return MeshCorrection(names, true, estimated, curve, draws, recalibrate(curve, draws), len(bodies) - len(counted))


def mesh_table(correction: MeshCorrection) -> Table:
    """Quantiles of λ/μ by tissue: of the posterior, of the posterior corrected for the mesh, and of the prior."""
    rows = []
    for index, name in enumerate(correction.names):
        for label, draws in (("on this mesh", correction.draws), ("allowing for it", correction.corrected)):
            levels = np.quantile(draws[:, index], RATIO_LEVELS)
            rows.append([f"{label_of(name)}, {label}", *map(number, levels)])
    low, high = np.log(RANGE)
    rows.append(["Prior", *(number(float(np.exp(low + level * (high - low)))) for level in RATIO_LEVELS)])
    header = ["", *(f"{level:.0%}".replace("%", " %") for level in RATIO_LEVELS)]
    caption = (
        f"{len(correction.true)} bodies of known λ/μ were pushed on a finer mesh and registered on this one. They show "
        "how far the λ/μ found on this mesh differs from the true one. The intervals “allowing for it” correct this "
        f"difference. Their prior is log-uniform from {RANGE[0]:g} to {RANGE[1]:g}: where they are as wide as the "
        "prior, this mesh says nothing about λ/μ." + _excluded_text(correction.failed)
    )
    return Table("λ/μ, allowing for the mesh", caption, header, [("", rows)])


def _excluded_text(failed: int) -> str:
    if not failed:
        return ""
    which = "1 more is" if failed == 1 else f"{failed} more are"
    return f" {which} left out, because the search for the mode failed."


def draw_ratios(correction: MeshCorrection) -> Figure:
    """Draw the estimated λ/μ of the bodies over their true λ/μ, and the intervals of the run.

    The dashed line is a mesh without error. The solid line is the average estimate on this mesh, with the other tissues
    as in the run. The band is the central 95 % interval of the run; the bar at the foot is the corrected interval, with
    its median.
    """
    with style.look():
        figure = style.new_figure(3.4)
        for index, panel in enumerate(figure.subplots(1, len(correction.names), squeeze=False)[0]):
            _panel(panel, correction, index)
    return figure


def _panel(panel: Axes, correction: MeshCorrection, index: int) -> None:
    low, high = np.quantile(correction.draws[:, index], (0.025, 0.975))
    estimated = correction.estimated[:, index]
    reach = (0.8 * RANGE[0], 1.25 * RANGE[1])
    heights = (min(reach[0], 0.8 * estimated.min(), 0.8 * low), max(reach[1], 1.25 * estimated.max(), 1.25 * high))
    foot = heights[0] * (heights[1] / heights[0]) ** 0.03
    panel.axhspan(low, high, color=style.ACCENT, alpha=0.2, linewidth=0)
    panel.plot(reach, reach, "--", color=style.MUTED, linewidth=1)
    grid = np.geomspace(*RANGE, 100)
    others = np.tile(1 / np.median(correction.corrected, axis=0), (len(grid), 1))
    others[:, index] = 1 / grid
    panel.plot(grid, np.exp(-correction.response(others)[:, index]), color=style.INK, linewidth=1)
    panel.scatter(correction.true[:, index], estimated, s=16, color=style.INK, zorder=3)
    corrected_low, corrected_median, corrected_high = np.quantile(correction.corrected[:, index], (0.025, 0.5, 0.975))
    panel.plot([corrected_low, corrected_high], [foot] * 2, color=style.ACCENT, linewidth=4, solid_capstyle="butt")
    panel.plot([corrected_median], [foot], "o", color="white", markeredgecolor=style.ACCENT, markersize=6, zorder=4)
    panel.set(xscale="log", yscale="log", xlim=reach, ylim=heights)
    panel.set(title=style.literal(label_of(correction.names[index])), xlabel="λ/μ of the body")
    if index == 0:
        panel.set_ylabel("λ/μ found")
