"""The pose of the moving image relative to the fixed one: the initial match, and the rigid part of the displacement."""

from __future__ import annotations

import numpy as np

from bayesreg.report.page import Sentences
from bayesreg.report.study import Study
from bayesreg.report.tables import Table
from bayesreg.report.verdict import decimal_text, nested_entry, place_text

NAMES = [
    f"{motion} {axis}, {unit}"
    for motion, unit in (("shift along", "mm"), ("turn about", "°"))
    for axis in ("x (R)", "y (A)", "z (S)")
]


def notes(study: Study) -> Sentences | None:
    """List the findings on pose, contrast and points, a sentence each; None without findings."""
    sentences = nested_entry(study.manifest, "appraisal", "notes")
    return Sentences("What was found of images and points", list(sentences)) if sentences else None


def pose_table(study: Study) -> Table:
    """Make a table of the rigid part of the organ's displacement: mean, sd and 95 % interval of its six numbers."""
    draws = np.asarray(study.predicted.motion).reshape(-1, 6)
    figures = np.stack([draws.mean(axis=0), draws.std(axis=0), *np.quantile(draws, (0.025, 0.975), axis=0)], axis=1)
    rows = [[name, *(decimal_text(value, 3) for value in row)] for name, row in zip(NAMES, figures, strict=True)]
    caption = (
        f"Shift of the organ’s centre, {place_text(study.predicted.centre)}, and turn about it (world RAS): the rigid "
        "motion nearest to each draw of the displacement, the pose included."
    )
    header = ["", "Mean", "Sd", "2.5 %", "97.5 %"]
    return Table("The rigid part of the displacement", caption, header, [("", rows)])
