"""Label tables of programs, and which of them fits a file."""

import pytest

from bayesreg.config.data import FilesData
from bayesreg.label_tables import TABLES, recognise_table
from bayesreg.tissues import BRAIN, ORGAN, tissue_names

# What SynthSeg writes without a parcellation; FreeSurfer's aseg holds some more.
SYNTHSEG = [2, 3, 4, 5, 7, 8, *range(10, 19), 24, 26, 28, 41, 42, 43, 44, 46, 47, *range(49, 55), 58, 60]


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_every_value_has_one_tissue(table):
    assert tissue_names(table) in (BRAIN, (ORGAN,))
    values = [value for entry in table.values() for value in entry]
    assert len(values) == len(set(values))
    assert 0 not in values


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
    ],
)
def test_a_table_is_recognised_by_the_values(values, name):
    assert recognise_table(values) == name


def test_a_configuration_names_one(tmp_path):
    path = tmp_path / "labels.nii"
    path.touch()
    data = {"source": "files", "labels": path, "label_table": "fast"}
    assert FilesData.model_validate(data).label_table == TABLES["fast"]
    with pytest.raises(ValueError, match="there is no label table 'fats'; expected fast, freesurfer, brainweb"):
        FilesData.model_validate(data | {"label_table": "fats"})
