"""The sections of a configuration, as pydantic models."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from bayesreg.config.values import ByTissue, Range, find_field
from bayesreg.settings import Count, FoundFile, NotNegative, Positive, Section, Vector
from bayesreg.settings import wrong as _wrong


class MeshConfig(Section):
    """How the mesh is made, or the file of an existing mesh."""

    edge_length: Positive | None = None
    """Desired length of the edges on the boundary, mm. null is 15.5 for a human brain, which gives a mesh of the
    paper's size; for the organ in a file, null is proportional to the size of this organ."""
    envelope: Positive | None = None
    """Largest distance of the mesh's surfaces from the surfaces of the labels, mm; null is 0.32 edge lengths."""
    skull_gap: NotNegative | None = None
    """Least distance of the boundary nodes from the skull, mm. null is 0.5 for a human brain; for the organ in a file,
    null is proportional to the size of this organ."""
    file: FoundFile | None = None
    """An existing mesh (.vtu); the other entries are then ignored."""


class StartConfig(Section):
    """The start of the chains."""

    field: Annotated[Literal["identity", "truth", "demons"] | Path, BeforeValidator(find_field)] = "identity"
    """identity, truth (of a synthetic pair), demons (of the pair of images, which must be of one contrast), or a file
    with a displacement of every node (.npz, .vtu) or a field on a grid (NIfTI, NRRD, MetaImage, ITK's transforms)."""
    fraction: Range = (0.0, 1.0)
    """The chains start at fractions of the field that are evenly spaced from the first to the second value."""
    lam: Positive | ByTissue | None = None
    """First Lamé parameter, for all tissues or by tissue; null is the median of a log-normal prior, else 10, in a fluid
    0.01. Fixed parameters keep their value."""
    mu: Positive | ByTissue | None = None
    """Second Lamé parameter, for all tissues or by tissue; null is the median of a log-normal prior, else 1, in a fluid
    0.01. Fixed parameters keep their value."""
    spread: NotNegative = 0.1
    """Standard deviation, between chains, of the logarithm of the Lamé parameters at the start."""

    def entries(self, name: Literal["lam", "mu"], names: Iterable[str]) -> dict[str, float] | None:
        """Return the start value of every named entry of λ or μ; None if the model chooses them."""
        start = getattr(self, name)
        return dict.fromkeys(names, start) if isinstance(start, float) else start


class StopConfig(Section):
    """The stop rule: sampling stops when the R-hat of every estimand is low enough, or a budget is spent."""

    rhat: Annotated[float, Field(strict=True, gt=1)] | None = 1.01
    """The largest R-hat of any estimand at which sampling stops; null runs until a budget is spent."""
    ess: Positive | None = 400.0
    """The least effective sample size (bulk and tail) of any estimand at which sampling stops; R-hat is then
    rank-normalised and split. null omits this rule and uses the unsplit R-hat of the paper."""
    max_steps: Count = 10_000
    """Largest number of steps per chain, thinned steps included."""
    max_minutes: Positive | None = None
    """Largest number of minutes for sampling, the search for the mode and the warm-up included."""


def _require_letters_and_digits(label: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9]+", label):
        raise ValueError("expected letters and digits alone, as BIDS wants its labels")
    return label


BidsLabel = Annotated[str, Field(strict=True), AfterValidator(_require_letters_and_digits)]


class BidsConfig(Section):
    """BIDS labels of the results; each has only letters and digits."""

    subject: BidsLabel
    session: BidsLabel | None = None
    fixed: BidsLabel = "preop"
    """The label of the fixed image's space."""
    moving: BidsLabel = "intraop"
    """The label of the moving image's space."""
    suffix: BidsLabel = "T1w"
    """The suffix of the moving image."""

    @model_validator(mode="after")
    def _two_spaces(self) -> BidsConfig:
        if self.fixed == self.moving:
            raise ValueError(f"fixed and moving are both {self.fixed!r}; a transform leads from one space to another")
        return self


class ResultsConfig(Section):
    """Optional result files for other programs."""

    draws: Annotated[int, Field(strict=True, ge=0)] = 0
    """The number of evenly spaced draws that are written as separate transforms and displacement fields."""
    bids: BidsConfig | None = None
    """BIDS labels; if given, the results are also written under the names of BIDS derivatives."""


class EvaluationConfig(Section):
    """Held-out landmarks for the evaluation of the result; the sampler does not use them."""

    landmarks: FoundFile
    """Pairs of points: both of each in one file (.csv, or .tag of two volumes), or those of the fixed image."""
    moving_landmarks: FoundFile | None = None
    """The points in the moving image, if they are in a separate file."""
    sd: Positive | None = None
    """Standard deviation of the localisation error of each coordinate, mm; null: the file's column sd, else zero."""


class ReportConfig(Section):
    """The content of the report."""

    places: dict[str, Vector] = Field(default={})
    """Places (x, y, z) in the fixed image, world RAS, mm, by name; if empty, the program chooses some."""

    @model_validator(mode="before")
    @classmethod
    def _landmarks_are_data(cls, section: Any) -> Any:
        if isinstance(section, dict) and "landmarks" in section:
            raise _wrong("landmarks", "this key is called report.places now; landmarks are data, see observations")
        return section
