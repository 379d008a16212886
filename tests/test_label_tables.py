"""Label tables of programs, and which of them fits a file."""

import pytest

from bayesreg.config.data import FilesData
from bayesreg.label_tables import REST, TABLES, as_range, read_label_names, recognise_tables
from bayesreg.tissues import BRAIN, ORGAN, tissue_names

# What SynthSeg writes without a parcellation; FreeSurfer's aseg holds some more.
SYNTHSEG = [2, 3, 4, 5, 7, 8, *range(10, 19), 24, 26, 28, 41, 42, 43, 44, 46, 47, *range(49, 55), 58, 60]


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_every_value_has_one_tissue(table):
    assert tissue_names(table) in (BRAIN, (ORGAN,), ("brain", "oedema", "tumour_core"))
    values = [value for entry in table.values() for value in entry]
    assert len(values) == len(set(values))
    assert (REST in values) == ("brain" in table)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ([0, 1, 2, 3], "fast"),
        (range(10), "brainweb"),
        ([0, *SYNTHSEG, 30, 31, 62, 63, 77, 85, *range(251, 256)], "freesurfer"),
        ([0, *SYNTHSEG], "freesurfer"),
        ([0, 1, 2, 3, 77777], None),
        ([0, 1], "mask"),
        ([0, 2], None),
        # Atropos: CSF, GM, WM, deep GM, brainstem, cerebellum.
        (range(7), None),
        ([2, 3, 4], None),
        ([0, 1, 2, 4], "brats"),
        ([0, 1, 2, 3, 4], None),
    ],
)
def test_a_table_is_recognised_by_the_values(values, name):
    assert (recognise_tables(values) or [None])[0] == name


def test_a_configuration_names_one(tmp_path):
    path = tmp_path / "labels.nii"
    path.touch()
    data = {"source": "files", "labels": path, "label_table": "fast"}
    assert FilesData.model_validate(data).label_table == TABLES["fast"]
    with pytest.raises(ValueError, match="there is no label table 'fats'; expected fast, freesurfer, brainweb"):
        FilesData.model_validate(data | {"label_table": "fats"})


def test_zero_may_be_background_without_a_mask(tmp_path):
    path = tmp_path / "labels.nii"
    path.touch()
    data = {"source": "files", "labels": path, "label_table": {"liver": 1, "background": 0}}
    assert FilesData.model_validate(data).tissues == ("liver",)


@pytest.mark.parametrize(("text", "labels"), [("7", [7]), ("1000-1003", [1000, 1001, 1002, 1003]), (" 5 - 6 ", [5, 6])])
def test_a_text_is_a_range_of_labels(text, labels):
    assert as_range(text) == labels


@pytest.mark.parametrize("text", ["", "wm", "3-1", "-4", "1.5", "1-9999999"])
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError, match="expected"):
        as_range(text)


FREESURFER_LINES = """#No. Label Name:                            R   G   B   A
0   Unknown                                 0   0   0   0
2   Left-Cerebral-White-Matter              245 245 245 0
41  Right-Cerebral-White-Matter             245 245 245 0
"""
SNAP_LINES = """# ITK-SnAP Label Description File
    0     0    0    0        0  0  0    "Clear Label"
    3   255    0    0        1  1  1    "Left lobe"
"""


def test_names_are_those_of_a_lookup_table(tmp_path):
    for name, text in {"freesurfer": FREESURFER_LINES, "snap": SNAP_LINES, "none": "nothing\n"}.items():
        (tmp_path / f"{name}.txt").write_text(text)
    label_names = read_label_names(tmp_path / "freesurfer.txt")
    assert label_names == {"Unknown": 0, "Left-Cerebral-White-Matter": 2, "Right-Cerebral-White-Matter": 41}
    assert read_label_names(tmp_path / "snap.txt")["Left lobe"] == 3
    with pytest.raises(ValueError, match="no label names"):
        read_label_names(tmp_path / "none.txt")


def test_a_table_may_hold_names_and_ranges(tmp_path):
    (tmp_path / "lut.txt").write_text(FREESURFER_LINES)
    names = ["Left-Cerebral-White-Matter", "Right-Cerebral-White-Matter"]
    options = {"source": "files", "label_names": str(tmp_path / "lut.txt"), "labels": str(tmp_path / "lut.txt")}
    data = FilesData(**options, label_table={"wm": names, "gm": ["1000-1002", 3]})
    assert data.label_table == {"wm": (2, 41), "gm": (1000, 1001, 1002, 3)}
    with pytest.raises(ValueError, match="'Left-Cerebellum' is no label"):
        FilesData(**options, label_table={"wm": ["Left-Cerebellum"]})
