"""Chains that disagree: which lie together, which estimands set them apart, and what each group would say."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from bayesreg.mesh import TetMesh
from bayesreg.report import panels, style
from bayesreg.report.estimands import AXES, DISPLACEMENT, MOST_VALUES
from bayesreg.report.panels import View
from bayesreg.report.places import regions
from bayesreg.report.slices import main_plane, planes_through
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import fixed, number, place_text
from bayesreg.types import AnyArray

# Chains lie apart where this many estimands differ by so many of their standard deviations within a chain.
APART = 3.0
TOGETHER_IN_ALL_BUT = 3
MOST_SHOWN = 4
NODES_SHOWN = 10
SEEN = (DISPLACEMENT, "lam", "mu", "t_similarity", "t_elastic", "field_sd", "field")


class Grouping(NamedTuple):
    """The groups of chains that lie together.

    Attributes
    ----------
    label : (chains,) int array
        Group of each chain, numbered from 0 in the order of their first chains.
    drifting : (chains,) bool array
        Whether the halves of a chain lie apart from one another: it is still on its way.
    """

    label: Int[np.ndarray, "chains"]
    drifting: Bool[np.ndarray, "chains"]

    @property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.label.max()) + 1

    def chains(self, group: int) -> np.ndarray:
        """The chains of a group."""
        return np.flatnonzero(self.label == group)


def grouping(posterior: xr.Dataset) -> Grouping:
    """Group chains whose means lie close together, measured by the standard deviation within chains."""
    values = _values(posterior)
    means, variances = values.mean(axis=1), values.var(axis=1)
    apart = np.array(
        [[_distance(_separation(means, variances, i, j)) for j in range(len(means))] for i in range(len(means))]
    )
    _, label = connected_components(apart < APART, directed=False)
    return Grouping(_renumber(label), np.array([_drifts(chain) for chain in values]))


def _renumber(label: np.ndarray) -> np.ndarray:
    _, first = np.unique(label, return_index=True)
    return np.argsort(np.argsort(first))[label]


def _values(posterior: xr.Dataset) -> Float[np.ndarray, "chains draws estimands"]:
    """All estimands side by side."""
    posterior = _fewer(posterior)
    found = [posterior[name] for name in SEEN if name in posterior]
    flat = [one.transpose("chain", "draw", ...).to_numpy().reshape(*_shape(one), -1) for one in found]
    return np.concatenate(flat, axis=-1).astype(float)


def _fewer(posterior: xr.Dataset) -> xr.Dataset:
    """Evenly thinned, where the draws would take much memory."""
    numbers = sum(posterior[name].size for name in SEEN if name in posterior)
    return posterior.isel(draw=slice(None, None, max(1, numbers // MOST_VALUES)))


def _shape(draws: xr.DataArray) -> tuple[int, int]:
    return draws.sizes["chain"], draws.sizes["draw"]


def _separation(means: np.ndarray, variances: np.ndarray, i: int, j: int) -> Float[np.ndarray, "estimands"]:
    """Distance of two means in standard deviations; none where both stand still at one place."""
    gap, within = np.abs(means[i] - means[j]), np.sqrt((variances[i] + variances[j]) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(gap > 0, gap / within, 0.0)


def _distance(separation: np.ndarray) -> float:
    """The separation that a few estimands reach: one alone may do so by chance, or be a parameter's tail."""
    rank = min(TOGETHER_IN_ALL_BUT, len(separation))
    return float(np.partition(separation, -rank)[-rank])


def _drifts(chain: Float[np.ndarray, "draws estimands"]) -> bool:
    halves = np.array_split(chain, 2)
    if len(halves[0]) < 2 or len(halves[1]) < 2:
        return True
    means, variances = (np.stack([getattr(half, figure)(axis=0) for half in halves]) for figure in ("mean", "var"))
    return _distance(_separation(means, variances, 0, 1)) >= APART


def explanation(found: Grouping) -> str:
    """A paragraph that says which groups there are, and what they may mean."""
    listed = "; ".join(f"group {k + 1}: {_chain_list(found.chains(k))}" for k in range(found.groups))
    text = (
        f"The chains lie in {found.groups} groups ({listed}): chain means of different groups are {APART:g} or more "
        "standard deviations within a chain apart in several estimands. "
    )
    moving = np.flatnonzero(found.drifting)
    if len(moving):
        text += (
            f"But {_chain_list(moving)} {'is' if len(moving) == 1 else 'are'} still moving: the two halves of the same "
            "chain differ as much. This looks like chains that have not arrived yet rather than like modes; run longer."
        )
    else:
        text += (
            "Each chain is steady in its place, which speaks for several modes. How many chains lie in a mode says "
            "nothing of its probability; the average over modes, shown elsewhere on this page, may be a displacement "
            "that none of them has."
        )
    return text


def _chain_list(chains: np.ndarray) -> str:
    numbers = [str(int(chain) + 1) for chain in chains]
    return ("chain " if len(numbers) == 1 else "chains ") + ", ".join(numbers)


def difference_table(mesh: TetMesh, posterior: xr.Dataset, found: Grouping) -> Table:
    """The displacements that set groups of chains apart most, one per node, with their places."""
    draws = _fewer(posterior)[DISPLACEMENT].transpose("chain", "draw", "node", "axis")
    values = draws.to_numpy().astype(float)
    nodes, means = draws["node"].to_numpy().astype(int), group_means(values.mean(axis=1), found)
    within = np.sqrt(values.var(axis=1).mean(axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        separation = np.where(np.ptp(means, axis=0) > 0, np.ptp(means, axis=0) / within, 0.0)
    axis = separation.argmax(axis=1)
    greatest = separation[np.arange(len(nodes)), axis]
    shown = np.argsort(-greatest, kind="stable")[:NODES_SHOWN]
    words = regions(mesh, mesh.points[nodes[shown]])
    rows = [
        [
            f"u_{AXES[axis[k]]} of node {nodes[k]}",
            place_text(tuple(mesh.points[nodes[k]].tolist())),
            where,
            *(fixed(float(mean)) for mean in means[:, k, axis[k]]),
            number(float(greatest[k])),
        ]
        for k, where in zip(shown, words, strict=True)
    ]
    names = [f"Group {k + 1}, mm" for k in range(found.groups)]
    caption = (
        "Mean of each group; apart: their range over the standard deviation within chains. One component per node."
    )
    return Table("Where the groups differ", caption, ["", "Place (x, y, z)", "Where", *names, "Apart"], [("", rows)])


def group_means(chain_means: Float[AnyArray, "chains *shape"], found: Grouping) -> Float[np.ndarray, "groups *shape"]:
    """Mean over the chains of each group."""
    return np.stack([np.asarray(chain_means)[found.chains(k)].mean(axis=0) for k in range(found.groups)])


def modes(view: View, found: Grouping) -> Drawing | None:
    """|ū| of each group side by side where they differ most; None where the chain means were not stored."""
    run = view.run
    if run.predicted is None:
        return None
    means = group_means(run.predicted.chain_mean, found)
    apart = np.linalg.norm(means[:, None] - means[None], axis=-1).max(axis=(0, 1))
    where = run.mesh.points[apart.argmax()]
    planes = planes_through(run.mesh, where)
    plane = main_plane(run.mesh, planes, apart[:, None] * np.array([1.0, 0.0, 0.0]))
    shown = min(found.groups, MOST_SHOWN)
    section = view.slice(plane)
    pictures = [np.linalg.norm(section.nodal(mean), axis=-1) for mean in means[:shown]]
    with style.look():
        height = style.WIDTH / (shown + 1.6) * np.ptp(plane.vertical) / np.ptp(plane.horizontal) + 0.5
        figure = style.new_figure(height)
        axes = figure.subplots(1, shown + 1)
        norm = panels.from_zero(*pictures)
        for k, (panel, picture) in enumerate(zip(axes, pictures, strict=False)):
            drawn = panels.field_panel(panel, picture, plane, norm, style.MAGNITUDE)
            panels.outline(panel, view, plane)
            panel.set_title(f"|ū| of group {k + 1} ({_chain_list(found.chains(k))})")
        panels.colourbar(figure, drawn, list(axes[:shown]), "mm", location="bottom", shrink=0.6, aspect=40)
        picture = section.nodal(apart[:, None])[..., 0]
        drawn = panels.field_panel(axes[-1], picture, plane, panels.from_zero(picture), style.ERROR)
        panels.outline(axes[-1], view, plane)
        panels.colourbar(figure, drawn, axes[-1], "mm", location="bottom")
        axes[-1].set_title("greatest distance between them")
        uri = style.data_uri(figure)
    more = "" if shown == found.groups else f" The first {shown} of {found.groups} groups are shown."
    place = place_text((float(where[0]), float(where[1]), float(where[2])))
    caption = (
        f"Mean displacement of each group of chains, {plane.title}, near the node where they lie farthest apart: "
        f"{number(float(apart.max()))} mm at {place}, {regions(run.mesh, where[None])[0]}.{more}"
    )
    alt = f"Norm of the mean displacement of {shown} groups of chains, and how far apart they lie."
    return Drawing("modes", "One picture for each group of chains", caption, alt, uri)
