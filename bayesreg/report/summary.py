"""The summary for a clinician: success, displacement, its uncertainty, and places of low reliability."""

from __future__ import annotations

import numpy as np

from bayesreg.report.places import regions
from bayesreg.report.study import Study
from bayesreg.report.verdict import decimal_text, nested_entry, number, percent, place_text
from bayesreg.types import AnyArray

# At a place whose 95 % radius is larger, mm, the result is of little use to a surgeon.
COARSE = 2.0


def answers(study: Study) -> list[tuple[str, str]]:
    """Answer five questions about a run."""
    return [
        ("Did it work?", _success(study)),
        ("What moved?", _pose(study)),
        ("How far?", _size(study)),
        ("How sure?", _certainty(study)),
        ("Where not to trust it?", _doubt(study)),
    ]


def _success(study: Study) -> str:
    converged = study.verdict.converged
    chains = "The chains agree." if converged else "Not yet: the chains do not agree, and all figures may change."
    return " ".join([chains, *_images(study), *_held_out(study), *_fits(study)])


def _images(study: Study) -> list[str]:
    """Describe the difference between the images before and after."""
    if study.image_differences is None:
        return []
    before, after = (number(value, 2) for value in study.image_differences)
    return [f"The images differ by {after} (root mean square, scaled intensity); before, {before}."]


def _held_out(study: Study) -> list[str]:
    """Describe the distances of held-out landmarks from their measured places, before and after."""
    predicted = study.predicted
    if predicted.evaluation_residual is None or not np.asarray(predicted.evaluation_inside).any():
        return []
    inside = np.asarray(predicted.evaluation_inside)
    before = np.asarray(predicted.evaluation_before)[inside].mean()
    after = np.linalg.norm(predicted.evaluation_residual, axis=1)[inside].mean()
    return [
        f"Landmarks that were held out lie {decimal_text(after, 1)} mm (mean) from their true place; before, "
        f"{decimal_text(before, 1)} mm."
    ]


def _fits(study: Study) -> list[str]:
    """Describe the size of the residuals of each observation, relative to the expectation of the model."""
    observed = nested_entry(study.manifest, "observations") or {}
    return [
        f"Residuals of {name.replace('_', ' ')}: {number(entry['residual_rms'], 2)} times what the model expects."
        for name, entry in observed.items()
        if entry.get("residual_rms") is not None
    ]


def _pose(study: Study) -> str:
    pose = study.run.matching.pose
    if pose.is_identity:
        return "The organ deformed; before and after share one coordinate system."
    motion = pose.about(study.mesh.points.mean(axis=0))
    if study.run.moving is None:
        source = "from its coordinates at rest in those of the points"
    else:
        source = "from where the header of the moving image has it"
    return (
        f"The organ lies {decimal_text(motion.millimetres, 1)} mm and {decimal_text(motion.degrees, 1)}° {source}; it "
        "deformed besides."
    )


def _size(study: Study) -> str:
    length = np.linalg.norm(study.run.u_mean, axis=1)
    middle, most = _quantile(study, length, 0.5), int(length.argmax())
    return (
        f"Half of the organ moved more than {decimal_text(middle, 1)} mm; the most, {decimal_text(length[most], 1)} "
        f"mm, is at {_place(study, most)}."
    )


def _certainty(study: Study) -> str:
    near, far = (_quantile(study, study.predicted.reach, level) for level in (0.5, 0.9))
    return (
        f"With a probability of 95 % a point lies within a radius of its mean place: at most {decimal_text(near)} mm "
        f"in half of the organ, at most {decimal_text(far)} mm in nine tenths."
    )


def _doubt(study: Study) -> str:
    radius = np.asarray(study.predicted.reach)
    least, share = int(radius.argmax()), study.mesh.nodal_volumes / study.mesh.nodal_volumes.sum()
    coarse = float(share[radius > COARSE].sum())
    text = f"The radius is greatest at {_place(study, least)}: {decimal_text(radius[least], 1)} mm. "
    text += f"In {percent(coarse)} of the organ it is above {COARSE:g} mm. " if coarse else ""
    return text + "The result says nothing of what lies outside the mesh."


def _place(study: Study, node: int) -> str:
    point = study.mesh.points[node]
    return f"{place_text(point)} ({regions(study.mesh, point[None])[0]})"


def _quantile(study: Study, values: AnyArray, level: float) -> float:
    """Return the quantile of nodal values at a level, weighted by volume."""
    order = np.argsort(values)
    share = np.cumsum(study.mesh.nodal_volumes[order]) / study.mesh.nodal_volumes.sum()
    return float(np.asarray(values)[order][np.searchsorted(share, level)])
