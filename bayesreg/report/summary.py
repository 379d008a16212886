"""What a clinician reads first: what moved, how far, how sure that is, and where not to trust it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesreg.io.records import Predicted, Run
from bayesreg.report.places import regions
from bayesreg.report.verdict import Verdict, fixed, percent, place_text
from bayesreg.types import AnyArray

# Beyond this 95 % radius a place is of little use to a hand, mm.
COARSE = 2.0


class Point(NamedTuple):
    """A question and its answer."""

    question: str
    answer: str


def summarise_run(run: Run, predicted: Predicted, judged: Verdict) -> list[Point]:
    """Four questions and their answers, in words."""
    mesh = run.mesh
    u, radius = np.linalg.norm(run.u_mean, axis=1), np.asarray(predicted.reach)
    share = mesh.nodal_volumes / mesh.nodal_volumes.sum()
    middle, most = _quantile(u, share, 0.5), int(u.argmax())
    least = int(radius.argmax())
    near, far = _quantile(radius, share, 0.5), _quantile(radius, share, 0.9)
    coarse = float(share[radius > COARSE].sum())
    where, doubtful = regions(mesh, mesh.points[[most, least]])
    trust = f"Least at {_place(mesh.points[least])} ({doubtful}): {fixed(float(radius[least]), 1)} mm. "
    trust += (
        f"In {percent(coarse)} of the organ that radius is above {COARSE:g} mm. "
        if coarse
        else f"It is below {COARSE:g} mm everywhere. "
    )
    trust += "Nothing is said of what lies outside the mesh."
    if not judged.converged:
        trust = f"Trust nothing yet: the sampler has not converged, and what stands here may change. {trust}"
    return [
        Point("What moved?", _pose(run)),
        Point(
            "How far?",
            f"Half of the organ by more than {fixed(middle, 1)} mm; the most, {fixed(float(u[most]), 1)} mm, at "
            f"{_place(mesh.points[most])} ({where}).",
        ),
        Point(
            "How sure?",
            f"Half of it is known to within {fixed(near)} mm, nine tenths to within {fixed(far)} mm: a point lies so "
            "far from its mean place at most, with a probability of 95 %.",
        ),
        Point("Where not to trust it?", trust),
    ]


def _pose(run: Run) -> str:
    """How the organ lies, in words."""
    if run.matching.pose.is_identity:
        return "The organ, in the one world in which it was seen before and after."
    motion = run.matching.pose.about(run.mesh.points.mean(axis=0))
    return (
        f"The organ lies {fixed(motion.millimetres, 1)} mm and {fixed(motion.degrees, 1)}° from where the header of "
        "the moving image has it; displacements come on top of that."
    )


def _place(point: AnyArray) -> str:
    x, y, z = (float(coordinate) for coordinate in np.asarray(point))
    return place_text((x, y, z))


def _quantile(values: AnyArray, share: AnyArray, level: float) -> float:
    """The value that so much of the volume does not exceed."""
    order = np.argsort(values)
    return float(np.asarray(values)[order][np.searchsorted(np.cumsum(np.asarray(share)[order]), level)])
