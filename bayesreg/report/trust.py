"""The reliability of the intervals of the displacement: which errors they include, and which they do not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bayesreg.report.page import Sentences
from bayesreg.report.study import Study
from bayesreg.report.verdict import nested_entry, number


def explain(study: Study) -> Sentences | None:
    """Write sentences on the intervals of a run; None if there is nothing to report."""
    sentences = explain_intervals(study.manifest)
    return Sentences("How far the intervals can be trusted", sentences) if sentences else None


def explain_intervals(manifest: Mapping[str, Any]) -> list[str]:
    """Explain which errors the standard deviations include besides independent noise, their size, and the reason."""
    return [*_correlated(manifest), *_outliers(manifest), *_mesh(manifest), *_folds(manifest)]


def _correlated(manifest: Mapping[str, Any]) -> list[str]:
    sentences = []
    for name, count in (nested_entry(manifest, "independent_points") or {}).items():
        points = nested_entry(manifest, "observations", name, "values")
        if not points or count > 0.99 * points:
            continue
        wider = math.sqrt(points / count)
        sentences.append(
            f"Neighbouring residuals are alike. Their correlation leaves {number(count)} of the {points:,} points that "
            f"are compared independent, by which the intervals are {number(wider, 2)} times as wide as if all were. "
            "What the model does not explain has its share in that."
        )
    return sentences


def _outliers(manifest: Mapping[str, Any]) -> list[str]:
    similarities = [
        similarity
        for name in nested_entry(manifest, "observations") or {}
        if (similarity := nested_entry(manifest, "observations", name, "options", "similarity"))
    ]
    forgiving = [settings["degrees_of_freedom"] for settings in similarities if settings["kind"] == "student_t"]
    if not forgiving:
        return []
    return [
        f"A residual far beyond the others counts for little (Student’s t with ν = {number(forgiving[0])}): a part of "
        "the images that has no counterpart widens the intervals there, and pulls little."
    ]


def _folds(manifest: Mapping[str, Any]) -> list[str]:
    share = nested_entry(manifest, "inverted_share_of_draws")
    if not share:
        return []
    return [
        f"In the draws, {number(100 * share, 2)} % of the tetrahedra are inside out, as no tissue can be: near them "
        "the intervals hold what is impossible. A barrier (model.least_volume: 0.1) keeps draws from there."
    ]


def _mesh(manifest: Mapping[str, Any]) -> list[str]:
    nodes, mesh = (nested_entry(manifest, "displacement_sd", name) for name in ("nodes", "mesh"))
    if nodes is None or mesh is None:
        return []
    return [
        f"Within a tetrahedron the displacement is linear. What the mesh cannot resolve, {number(mesh, 2)} mm (root "
        "mean square over voxels and axes) by the loads and the stiffness that were inferred, is part of the sd of "
        f"each voxel in displacement_sd.nii.gz, beside the posterior’s own, {number(nodes, 2)} mm; figures show the "
        "latter alone."
    ]
