"""Pairs of points in a configuration: their section of the YAML, their reader, and their part of the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from bayesreg.io.point_formats import PointPairs
from bayesreg.io.points import read_point_pairs
from bayesreg.io.records import Inputs
from bayesreg.model.observations.landmarks import ROBUST, UNKNOWN_SD, Landmarks
from bayesreg.model.observations.landmarks_report import distance_figure, landmark_table
from bayesreg.model.observations.point_noise import Noise
from bayesreg.model.observations.section import Arrays, Name, ObservationSection, ReportFigure, ReportTable
from bayesreg.settings import FoundFile, KnownOrInferred, ScalePrior


class LandmarksSection(ObservationSection):
    """Pairs of points that show the same place of the organ."""

    title = "pairs of points"

    kind: Literal["landmarks"] = "landmarks"
    name: Name = "landmarks"
    """The name of the observation in tables; two observations need two."""
    file: FoundFile
    """Both points of each pair (.csv, or .tag of two volumes), or the points in the fixed image (.csv, .fcsv,
    .mrk.json, .tag)."""
    moving_file: FoundFile | None = None
    """The points in the moving image, where they stand in a file of their own."""
    second_file: FoundFile | None = None
    """The points in the moving image as read a second time, where they are no columns of the file: they tell the sd."""
    sd: KnownOrInferred | tuple[KnownOrInferred, KnownOrInferred, KnownOrInferred] | None = None
    """Sd of the error of each coordinate, mm, or its prior, or three of these for the axes x, y and z; null takes the
    column sd of the file, and without one infers it, by a second reading where there is one."""
    noise: Noise = ROBUST
    """The distribution of the errors: student_t, with a few large ones, or normal."""

    def read(self) -> dict[str, np.ndarray]:
        """Read the points from the files, world RAS mm."""
        return read_point_pairs(self.file, self.moving_file, self.second_file).as_arrays()

    def observe(self, inputs: Inputs) -> Sequence[Landmarks]:
        """Make the landmarks; those of the moving image are transformed into the world of the fixed one."""
        pairs = PointPairs.of_arrays(inputs.observed[self.name])
        labels = [name or str(index) for index, name in enumerate(pairs.names, start=1)] or None
        given = pairs.sd if self.sd is None else self.sd
        sd = UNKNOWN_SD if given is None and pairs.second is None else given
        if isinstance(sd, tuple) and not any(isinstance(prior, ScalePrior) for prior in sd):
            sd = np.array([sd])
        aligned = inputs.matching.pose.inverse
        moving, second = (None if side is None else aligned.place(side) for side in (pairs.moving, pairs.second))
        grid = {"the labels": inputs.tissue} if inputs.fixed is None else {"the fixed image": inputs.fixed}
        return [Landmarks(pairs.fixed, moving, sd, self.name, labels, self.noise, second, grid)]

    @classmethod
    def tables(cls, name: str, summary: Arrays) -> list[ReportTable]:
        """Return a table of every landmark."""
        return [landmark_table(name, summary)] if "residual" in summary else []

    @classmethod
    def figures(
        cls, name: str, summary: Arrays, tissues: Sequence[str], described: Mapping[str, Any]
    ) -> list[ReportFigure]:
        """Return a figure of the distances between the landmarks and their predicted places."""
        return [distance_figure(name, summary)] if "residual" in summary else []
