"""Define the base class of checked settings, and the types of their values."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo
from pydantic_core import PydanticCustomError

from bayesreg.types import DATA_FOLDER


class Section(BaseModel):
    """A record of settings, such as a section of a configuration. It refuses unknown keys and cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


def is_stored(info: ValidationInfo) -> bool:
    """Report whether a configuration is stored in a run folder; the files that it names may then be missing."""
    return bool((info.context or {}).get("stored"))


def find_file(value: object, info: ValidationInfo) -> Path:
    """Find the path of an existing file; the ValueError for a missing file names the searched places."""
    return _find(value, info, Path.is_file)


def _find_image(value: object, info: ValidationInfo) -> Path:
    """Find the path of an existing file, or of a folder with a DICOM series."""
    return _find(value, info, Path.exists)


def _find(value: object, info: ValidationInfo, serves: Callable[[Path], bool]) -> Path:
    if not isinstance(value, str | Path) or not str(value):
        raise ValueError("expected the path of a file")
    if is_stored(info):
        return Path(value)
    folders = (info.context or {}).get("folders", ()) or search_folders()
    paths = list(dict.fromkeys((folder / Path(value).expanduser()).absolute() for folder in folders))
    for path in paths:
        try:
            if serves(path):
                return path
        except (OSError, ValueError) as error:
            raise ValueError(f"no path of a file: {getattr(error, 'strerror', None) or error}") from None
    hint = "" if Path(value).is_absolute() or os.environ.get(DATA_FOLDER) else f" (and {DATA_FOLDER} is not set)"
    raise ValueError(f"no such file; looked for {' and '.join(map(str, paths))}{hint}")


def search_folders(*beside: Path) -> list[Path]:
    """List the folders in which relative paths are searched, in this order."""
    data = os.environ.get(DATA_FOLDER)
    return [*beside, Path.cwd(), *([Path(data)] if data else [])]


def by_kind(value: object) -> object:
    """Convert the name of a kind, such as `similarity: lncc`, to a mapping with this kind."""
    return {"kind": value} if isinstance(value, str) else value


def wrong(key: str, message: str) -> PydanticCustomError:
    """Make an error for one key, given by its dotted path in the section whose validator raises the error."""
    return PydanticCustomError("wrong", "{message}", {"message": message, "key": key})


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(strict=True, ge=1, le=1_000_000_000)]
Vector = tuple[Number, Number, Number]
FoundFile = Annotated[Path, BeforeValidator(find_file)]
FoundImage = Annotated[Path, BeforeValidator(_find_image)]


class ScalePrior(Section):
    """Log-normal prior of a positive number, such as a temperature, the sd of an error, λ or μ.

    Attributes
    ----------
    median : float
        The median in the unit of the number, positive.
    log_sd : float
        Standard deviation of the natural logarithm of the number, positive. With 1, the ends of the 95 % interval
        differ by a factor of 50.
    """

    median: Positive
    log_sd: Positive = 1.0


# A known positive number, or the prior of an inferred number.
KnownOrInferred = Positive | ScalePrior


def is_inferred(scale: Any) -> bool:
    """Report whether a scale has a prior, rather than a known value."""
    return isinstance(scale, ScalePrior)
