"""Label tables of programs that many use: the values in their files by tissue."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from bayesreg.tissues import BACKGROUND, ORGAN

# FreeSurfer's aseg and aparc+aseg (FreeSurferColorLUT.txt), and SynthSeg, which takes its values from there. Brainstem,
# ventral diencephalon and optic chiasm are mixtures: the first and the last count as white matter.
_FREESURFER = {
    "csf": (4, 5, 14, 15, 24, 31, 43, 44, 63, 72),
    "gm": (
        *(3, 8, 9, 10, 11, 12, 13, 17, 18, 19, 20, 26, 27, 28),
        *(42, 47, 48, 49, 50, 51, 52, 53, 54, 55, 56, 58, 59, 60),
        *(80, 81, 82),
        *range(1000, 1036),
        *range(2000, 2036),
    ),
    "wm": (
        *(2, 7, 16, 30, 41, 46, 62, 77, 78, 79, 85),
        *range(251, 256),
        *range(3000, 3036),
        *range(4000, 4036),
        *(5001, 5002),
    ),
}

TABLES: Mapping[str, Mapping[str, tuple[int, ...]]] = {
    "fast": {"csf": (1,), "gm": (2,), "wm": (3,)},
    "freesurfer": _FREESURFER,
    # Collins 1998. Glial matter (8) counts as GM; fat, muscle, skin, skull and connective tissue are not of the brain.
    "brainweb": {"csf": (1,), "gm": (2, 8), "wm": (3,), BACKGROUND: (4, 5, 6, 7, 9)},
    # A mask of the organ is a label file of one label.
    "mask": {ORGAN: (1,)},
}


# Labels by which a table is known: others have some of its values, too.
_MARKS = {"fast": {1, 2, 3}, "freesurfer": {2, 3, 41, 42}, "brainweb": {1, 2, 3, 8}, "mask": {1}}


def recognise_table(values: Iterable[int]) -> str | None:
    """The first table that lists all of some values of a label file, zero aside, and whose marks are among them."""
    found = set(values) - {0}
    for name, table in TABLES.items():
        if _MARKS[name] <= found <= {value for entry in table.values() for value in entry}:
            return name
    return None
