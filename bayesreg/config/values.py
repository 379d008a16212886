"""Types of values in a configuration: tables of labels, ranges, directions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo

from bayesreg.label_tables import TABLES, as_range, name_values, read_label_names
from bayesreg.settings import Positive, Vector, find_file, is_stored
from bayesreg.tissues import BACKGROUND, tissue_names


def find_field(value: object, info: ValidationInfo) -> object:
    """Return the keywords identity, truth and demons unchanged; find the file that any other value names."""
    return value if value in ("identity", "truth", "demons") else find_file(value, info)


def find_boundary(value: object, info: ValidationInfo) -> object:
    """Return the keyword truth and null (None) unchanged; find the file that any other value names."""
    return value if value in (None, "truth") else find_file(value, info)


def _as_pair(value: object) -> object:
    return (value, value) if isinstance(value, int | float) else value


def _as_list(value: object) -> object:
    """Convert one label or a list of labels to a tuple; a text such as 1000-1035 includes both ends.

    A value of another type is returned unchanged, for Pydantic to check.
    """
    several = (value,) if isinstance(value, int | str) and not isinstance(value, bool) else value
    if not isinstance(several, Sequence):
        return value
    labels: list[object] = []
    for label in several:
        labels += as_range(label) if isinstance(label, str) else [label]
    return tuple(labels)


def _ascending(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError("expected the lower value first")
    return pair


def _unit(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    length = math.hypot(*vector)
    if length == 0:
        raise ValueError("expected a direction that is not zero")
    if math.isclose(length, 1, rel_tol=1e-12):
        return vector  # A division could change the last bit of a direction in a stored configuration.
    x, y, z = (component / length for component in vector)
    return x, y, z


Label = Annotated[int, Field(strict=True)]
Labels = Annotated[tuple[Label, ...], BeforeValidator(_as_list), Field(min_length=1)]
Fraction = Annotated[float, Field(strict=True, ge=0, le=2)]
Range = Annotated[tuple[Fraction, Fraction], BeforeValidator(_as_pair), AfterValidator(_ascending)]
Direction = Annotated[Vector, AfterValidator(_unit)]


def _table(table: dict[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """Return a table of labels by tissue unchanged, or raise ValueError if it is unsuitable.

    A table is unsuitable if the name of a tissue is not allowed, if there is no tissue besides the background or more
    than 127, or if a label has more than 32 bits or belongs to two tissues.
    """
    if not table:
        raise ValueError("expected at least one tissue with its labels, such as liver: 1")
    if not 0 < len(tissue_names(table)) < 128:
        raise ValueError("expected at least one tissue besides the background, and at most 127")
    owners: dict[int, str] = {}
    for name, labels in table.items():
        if name.lower() == BACKGROUND and name != BACKGROUND:
            raise ValueError(f"{name!r} is no name of a tissue; write {BACKGROUND} for labels of no tissue")
        if not name.isidentifier():
            raise ValueError(f"{name!r} is no name of a tissue; expected letters, digits and _, such as left_lobe")
        if name == "all":
            raise ValueError("the name 'all' stands for all tissues; expected another name for this tissue")
        for label in labels:
            if abs(label) >= 2**31:
                raise ValueError(f"label {label} of {name} has more than 32 bits")
            if owners.setdefault(label, name) != name:
                raise ValueError(f"label {label} belongs to {owners[label]} already, and cannot belong to {name}")
    return table


def _named_table(value: object, info: ValidationInfo) -> object:
    """Return the label table that a text such as freesurfer names, or replace label names in a table by their values.

    The values of label names come from the lookup table `label_names`, if it is given.
    """
    label_names = info.data.get("label_names")
    # The table of a stored configuration holds only numbers, so that the lookup table is not needed.
    if isinstance(value, dict) and label_names is not None and not is_stored(info):
        names = read_label_names(label_names)
        return {tissue: name_values(entry, names) for tissue, entry in value.items()}
    if not isinstance(value, str):
        return value
    if value not in TABLES:
        raise ValueError(f"there is no label table {value!r}; expected {', '.join(TABLES)}, or labels by tissue")
    return dict(TABLES[value])


LabelTable = Annotated[dict[str, Labels], AfterValidator(_table), BeforeValidator(_named_table)]
ByTissue = dict[str, Positive]
