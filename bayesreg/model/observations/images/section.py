"""The section of a configuration for a pair of images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from pydantic import model_validator

from bayesreg.io.records import Inputs
from bayesreg.model.observations.images.options import ImageOptions
from bayesreg.model.observations.images.pair import ImagePair
from bayesreg.model.observations.images.report import check_table, residual_figure, support_figure
from bayesreg.model.observations.images.similarity import SIMILARITIES
from bayesreg.model.observations.section import Arrays, Name, ObservationSection, ReportFigure, ReportTable
from bayesreg.settings import FoundImage
from bayesreg.types import InputError

# The options of images whose contrasts are related patch by patch only.
IN_PATCHES: Mapping[str, Any] = {"similarity": {"kind": "lc2"}, "intensity_map": None}

PSEUDO_LIKELIHOOD = (
    "With this the images have a pseudo-likelihood: it is not the density of images that a model draws, and the width "
    "of its intervals rests on the number of independent points, which is estimated from the residuals"
)


class ImagesSection(ObservationSection, ImageOptions):
    """The pair of images of the section data, or, with a name and files, another pair of the same two visits, such as
    FLAIR beside T1."""

    title = "pair of images"

    kind: Literal["images"] = "images"
    name: Name = "images"
    """The name of the pair in tables; images is that of the section data."""
    fixed: FoundImage | None = None
    """Another image in the world of data.fixed."""
    moving: FoundImage | None = None
    """Another image in the world of data.moving."""

    @model_validator(mode="after")
    def _is_whole(self) -> ImagesSection:
        if (self.fixed is None) != (self.moving is None):
            raise ValueError("a pair of images needs both, fixed and moving")
        if (self.fixed is None) != (self.name == "images"):
            raise ValueError("a pair besides that of the section data needs a name, fixed and moving")
        return self

    @property
    def options(self) -> dict[str, Any]:
        """The options of the comparison of the images."""
        return {name: getattr(self, name) for name in ImageOptions.model_fields}

    def observe(self, inputs: Inputs) -> Sequence[ImagePair]:
        """Make the pair with both images in one world, by the matched pose."""
        if inputs.fixed is None or inputs.moving is None:
            raise InputError("the run compares images, and its folder holds none: inputs/fixed.nii.gz is missing")
        images = inputs.fixed, inputs.moving, self.name, inputs.fixed_ignore, inputs.moving_ignore
        if self.name == "images":
            options = {**self.options, **(IN_PATCHES if inputs.matching.in_patches else {})}
            return [ImagePair(*images, inputs.matching.one_contrast, inputs.tissue, **options)]
        channel = inputs.channels[self.name]
        tissue = channel.fixed.with_voxels(inputs.tissue.nearest(channel.fixed.grid_points()))
        return [ImagePair(channel.fixed, channel.moving, *images[2:], channel.one_contrast, tissue, **self.options)]

    @classmethod
    def log_density(cls, name: str) -> str:
        """Return −E_s / T_s in HTML, with the name of the pair if it is not the main pair."""
        pair_suffix = "" if name == "images" else f"({name})"
        return f" − <var>E</var><sub>s</sub>{pair_suffix} / <var>T</var><sub>s</sub>{pair_suffix}"

    @classmethod
    def explain(cls, name: str, described: Mapping[str, Any]) -> str:
        """Return the formula of E_s of the similarity, and what its likelihood is where it is not a density of f."""
        options = described["options"]
        similarity = SIMILARITIES[options["similarity"]["kind"]]
        formula = f"<var>E</var><sub>s</sub>{'' if name == 'images' else f'({name})'} = {similarity.formula}"
        is_density = options["similarity"]["kind"] in ("ssd", "student_t") and options["intensity_map"] is None
        return formula if is_density and options["independent_points"] is None else f"{formula}. {PSEUDO_LIKELIHOOD}"

    @classmethod
    def tables(cls, name: str, summary: Arrays) -> list[ReportTable]:
        """Return the table of posterior predictive checks."""
        return [check_table(name, summary)] if "observed" in summary else []

    @classmethod
    def figures(
        cls, name: str, summary: Arrays, tissues: Sequence[str], described: Mapping[str, Any]
    ) -> list[ReportFigure]:
        """Return the figures of the residual, with its expected distribution, and of the places without support."""
        if "residual" not in summary:
            return []
        similarity = described["options"]["similarity"]
        residual = SIMILARITIES[similarity["kind"]].residual
        figures = [residual_figure(name, summary, tissues, similarity, residual)]
        return [*figures, support_figure(name, summary)] if "support" in summary else figures
