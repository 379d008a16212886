"""The sections of a configuration that say what was observed."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from bayesreg.config.values import FoundFile, FoundImage, Positive, Section
from bayesreg.model.options import ScalePrior, is_taken


def _free_name(name: str) -> str:
    if not name.isidentifier():
        raise ValueError("expected a name of letters, digits and _, such as left_lobe")
    if is_taken(name) or name == "images":
        raise ValueError("this name is taken; expected another one")
    return name


class ImagesSection(Section):
    """The pair of images of the section data, or, with a name and files, another pair of the same two visits, such as
    FLAIR beside T1; compared as the section model says."""

    kind: Literal["images"]
    name: str = "images"
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
        if self.name != "images":
            _free_name(self.name)
        return self


class LandmarksSection(Section):
    """Pairs of points that show the same place of the organ."""

    kind: Literal["landmarks"]
    file: FoundFile
    """Both points of each pair (.csv, or .tag of two volumes), or the points in the fixed image (.csv, .fcsv,
    .mrk.json, .tag)."""
    moving_file: FoundFile | None = None
    """The points in the moving image, where they stand in a file of their own."""
    sd: Positive | ScalePrior | None = None
    """Sd of the error of each coordinate, mm, or its prior; null takes the column sd of the file."""
    name: Annotated[str, AfterValidator(_free_name)] = "landmarks"
    """The name of the observation in tables; two observations need two."""


Observation = Annotated[ImagesSection | LandmarksSection, Field(discriminator="kind")]


def _of_different_names(given: list[Observation] | None) -> list[Observation] | None:
    names = [one.name for one in given or []]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two observations are named {name}; give one of them another name")
    return given


Observations = Annotated[list[Observation] | None, AfterValidator(_of_different_names)]
