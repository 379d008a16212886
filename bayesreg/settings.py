"""Checked records of settings: their base, and the kinds of values that they hold."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo
from pydantic_core import PydanticCustomError

from bayesreg.types import DATA_FOLDER


class Section(BaseModel):
    """A record of settings, such as a part of a configuration: no unknown keys, no changes after the making."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


def is_stored(info: ValidationInfo) -> bool:
    """Whether a configuration is that of a run folder, which holds what was made of the files that it names."""
    return bool((info.context or {}).get("stored"))


def find_file(value: object, info: ValidationInfo) -> Path:
    """The path of a file that exists; ValueError says where it was looked for."""
    return _find(value, info, Path.is_file)


def _find_image(value: object, info: ValidationInfo) -> Path:
    """A file, or a folder with a DICOM series."""
    return _find(value, info, Path.exists)


def _find(value: object, info: ValidationInfo, serves: Callable[[Path], bool]) -> Path:
    if not isinstance(value, str | Path) or not str(value):
        raise ValueError("expected the path of a file")
    if is_stored(info):
        return Path(value)
    folders = (info.context or {}).get("folders", ()) or search_folders()
    places = list(dict.fromkeys((folder / Path(value).expanduser()).absolute() for folder in folders))
    for place in places:
        try:
            if serves(place):
                return place
        except (OSError, ValueError) as error:
            raise ValueError(f"no path of a file: {getattr(error, 'strerror', None) or error}") from None
    hint = "" if Path(value).is_absolute() or os.environ.get(DATA_FOLDER) else f" (and {DATA_FOLDER} is not set)"
    raise ValueError(f"no such file; looked for {' and '.join(map(str, places))}{hint}")


def search_folders(*beside: Path) -> list[Path]:
    """Where relative paths are looked for, the first place first."""
    data = os.environ.get(DATA_FOLDER)
    return [*beside, Path.cwd(), *([Path(data)] if data else [])]


def by_kind(value: object) -> object:
    """A record that is given by the name of its kind alone, such as `similarity: lncc`, as a mapping."""
    return {"kind": value} if isinstance(value, str) else value


def wrong(key: str, message: str) -> PydanticCustomError:
    """An error that belongs to one key, given by its dotted path, of the section whose validator raises it."""
    return PydanticCustomError("wrong", "{message}", {"message": message, "key": key})


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(strict=True, ge=1, le=1_000_000_000)]
Vector = tuple[Number, Number, Number]
FoundFile = Annotated[Path, BeforeValidator(find_file)]
FoundImage = Annotated[Path, BeforeValidator(_find_image)]


class ScalePrior(Section):
    """Log-normal prior of a positive number, such as a temperature or the standard deviation of an error.

    Attributes
    ----------
    median : float
        In the unit of the number, positive.
    log_sd : float
        Standard deviation of its natural logarithm, positive; 1 spans a factor of 50 with 95 %.
    """

    median: Positive
    log_sd: Positive = 1.0


# A positive number that is known, or the prior of one that is inferred.
KnownOrInferred = Positive | ScalePrior


def is_inferred(scale: Any) -> bool:
    """Whether a scale has a prior, and is not a known number."""
    return isinstance(scale, ScalePrior)
