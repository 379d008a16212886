"""Define label tables: the values in label files by tissue, for common programs, as ranges, or by label names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from bayesreg.tissues import BACKGROUND, ORGAN

# FreeSurfer's aseg, aparc+aseg, aparc.a2009s+aseg and wmparc (FreeSurferColorLUT.txt), and SynthSeg, which takes its
# values from there. Brainstem, optic chiasm and ventral diencephalon are mixtures of tissues: the first two count as
# WM, the last as GM.
_FREESURFER = {
    "csf": (4, 5, 14, 15, 24, 31, 43, 44, 63, 72),
    "gm": (
        *(3, 8, 9, 10, 11, 12, 13, 17, 18, 19, 20, 26, 27, 28),
        *(42, 47, 48, 49, 50, 51, 52, 53, 54, 55, 56, 58, 59, 60),
        *(80, 81, 82),
        *range(1000, 1036),
        *range(2000, 2036),
        *range(11100, 11176),
        *range(12100, 12176),
    ),
    "wm": (
        *(2, 7, 16, 30, 41, 46, 62, 77, 78, 79, 85),
        *range(251, 256),
        *range(3000, 3036),
        *range(4000, 4036),
        *range(13100, 13176),
        *range(14100, 14176),
        192,
        *(5001, 5002),
    ),
}

# The value of unlabelled voxels. A table may give it to a tissue, which is then the rest of the intracranial mask.
REST = 0

TABLES: Mapping[str, Mapping[str, tuple[int, ...]]] = {
    "fast": {"csf": (1,), "gm": (2,), "wm": (3,)},
    "freesurfer": _FREESURFER,
    # Collins 1998. Glial matter (8) counts as GM; fat, muscle, skin, skull and connective tissue are no brain tissue.
    "brainweb": {"csf": (1,), "gm": (2, 8), "wm": (3,), BACKGROUND: (4, 5, 6, 7, 9)},
    # Tumour labels: necrotic core, oedema and enhancing tumour, whose label was 4 until 2021 and is 3 since 2023.
    "brats": {"brain": (REST,), "oedema": (2,), "tumour_core": (1, 4)},
    "brats2023": {"brain": (REST,), "oedema": (2,), "tumour_core": (1, 3)},
    # A mask of the organ is a label file with one label.
    "mask": {ORGAN: (1,)},
}


# A longer range of labels is taken for a typing error.
LONGEST_RANGE = 100_000

# The labels that must occur for a table to be recognised, because several tables share values.
_MARKS = {
    "fast": {1, 2, 3},
    "freesurfer": {2, 3, 41, 42},
    "brainweb": {1, 2, 3, 8},
    "brats": {1, 2, 4},
    # This table has the same values as fast, which is likelier; therefore a user must name it.
    "brats2023": {1, 2, 3},
    "mask": {1},
}


def recognise_tables(values: Iterable[int]) -> list[str]:
    """Return the tables that list all values of a label file except zero, and whose marks are among the values.

    The likeliest table comes first.
    """
    labels = set(values) - {0}
    listed = {name: {value for entry in table.values() for value in entry} for name, table in TABLES.items()}
    return [name for name in TABLES if _MARKS[name] <= labels <= listed[name]]


def as_range(text: str) -> list[int]:
    """Parse the labels in a text such as 7 or 1000-1035, its ends included; ValueError for any other text."""
    ends = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?", text)
    if ends is None:
        raise ValueError(f"{text!r} is no label; expected a whole number, a range such as 1000-1035, or a name with "
                         "label_names")  # fmt: skip
    first, last = int(ends[1]), int(ends[2] or ends[1])
    if not first <= last < first + LONGEST_RANGE:
        raise ValueError(
            f"{text!r} is no range of labels; expected the lower first, and at most {LONGEST_RANGE:,} of them"
        )
    return list(range(first, last + 1))


def read_label_names(path: str | Path) -> dict[str, int]:
    """Read the labels by name from a lookup table of FreeSurfer, 3D Slicer (.ctbl) or ITK-SNAP.

    Raises
    ------
    ValueError
        If the file has no label names.
    """
    labels: dict[str, int] = {}
    for line in Path(path).read_text(encoding="utf-8", errors="replace").splitlines():
        quoted = re.fullmatch(r'\s*(\d+)\s.*"([^"]+)"\s*', line)
        plain = re.match(r"\s*(\d+)\s+([^\s\d#]\S*)", line)
        if entry := quoted or plain:
            labels[entry[2]] = int(entry[1])
    if not labels:
        raise ValueError(
            f"{path} holds no label names; expected lines such as: 2 Left-Cerebral-White-Matter 245 245 245 0"
        )
    return labels


def name_values(entry: object, values_by_name: Mapping[str, int]) -> object:
    """Replace the names of labels in an entry of a table by their values."""
    several = entry if isinstance(entry, list | tuple) else [entry]
    return [values_by_name.get(label, label) if isinstance(label, str) else label for label in several]
