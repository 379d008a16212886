import json

import numpy as np
import pytest

from bayesreg.io.atomic import load_arrays, read_json, replacing, save_arrays, write_json


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(OSError, match="no space"):
        _fail_half_way(path)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


def _fail_half_way(path):
    with replacing(path) as temporary:
        temporary.write_text("half of the new")
        raise OSError("no space left on the disk")


def test_until_the_end_readers_see_the_old_content(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"


def test_the_temporary_name_keeps_the_ending(tmp_path):
    with replacing(tmp_path / "image.nii.gz") as temporary:
        temporary.touch()
        assert temporary.name.endswith("image.nii.gz")
        assert temporary.parent == tmp_path


def test_json_turns_what_is_not_finite_into_null_and_numpy_into_plain(tmp_path):
    value = {
        "bad": [float("nan"), np.inf, -np.float64("inf")],
        "array": np.array([[1.5, np.nan]]),
        "integer": np.int64(3),
        "truth": np.bool_(True),
        "path": tmp_path,
        7: ("λ", None),
    }
    write_json(tmp_path / "a.json", value)
    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    assert "NaN" not in text
    assert "Infinity" not in text
    assert json.loads(text) == {
        "bad": [None, None, None],
        "array": [[1.5, None]],
        "integer": 3,
        "truth": True,
        "path": str(tmp_path),
        "7": ["λ", None],
    }


def test_damaged_files_are_named(tmp_path):
    (tmp_path / "a.json").write_text('{"half": ')
    with pytest.raises(ValueError, match=r"a\.json is not valid JSON"):
        read_json(tmp_path / "a.json")
    save_arrays(tmp_path / "a.npz", {"x": np.arange(1000.0)})
    content = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"a\.npz is damaged .*; copy it again"):
        load_arrays(tmp_path / "a.npz", "copy it again")


def test_arrays_come_back_bit_for_bit(tmp_path):
    arrays = {"x": np.random.default_rng(0).normal(size=(3, 4)), "key": np.array([1, 2], np.uint32), "n": np.array(5)}
    save_arrays(tmp_path / "a.npz", arrays)
    loaded = load_arrays(tmp_path / "a.npz", "")
    assert set(loaded) == set(arrays)
    for name, value in arrays.items():
        assert loaded[name].dtype == value.dtype
        np.testing.assert_array_equal(loaded[name], value)
