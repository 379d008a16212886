"""What a user can get wrong in files and folders is told at once, with status 2, before any long work."""

import nibabel as nib
import numpy as np
import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from bayesreg.cli import app
from bayesreg.workflow import meshing

SHAPE = (24, 24, 24)


class LongWorkError(Exception):
    """Meshing has been asked for."""


@pytest.fixture
def pair(tmp_path, monkeypatch):
    """The files of a sound pair; `pair(key=value)` checks a configuration with some entries of `data` changed."""

    def build_mesh(*_):
        raise LongWorkError

    monkeypatch.setattr(meshing, "build_mesh", build_mesh)
    radius = np.linalg.norm(np.indices(SHAPE) - 11.5, axis=0)
    labels = np.select([radius < 2, radius < 6, radius < 8], [1, 3, 2], 0)
    image = np.random.default_rng(0).normal(labels, 0.1)
    contents = {"fixed": image, "moving": image, "labels": labels, "intracranial": radius < 10}
    data = {"source": "files", "label_table": {"csf": [1], "gm": [2], "wm": [3]}}
    for name, voxels in contents.items():
        data[name] = str(save(tmp_path / f"{name}.nii.gz", voxels))

    def check(*command: str, start=None, **changed):
        YAML(typ="safe").dump({"data": data | changed, "start": start or {}}, tmp_path / "run.yaml")
        command = command or ("check",)
        return CliRunner().invoke(app, [command[0], str(tmp_path / "run.yaml"), *command[1:]])

    return check


def save(path, voxels, affine=None):
    header = nib.Nifti1Header()
    header.set_sform(np.diag([4, 4, 4, 1]) if affine is None else affine, code=1)  # Singular ones, too.
    nib.save(nib.Nifti1Image(np.asarray(voxels, np.float32), None, header), path)
    return path


def not_an_image(folder):
    (folder / "bad.nii.gz").write_bytes(b"no image")
    return folder / "bad.nii.gz"


def two_parts():
    mask = np.zeros(SHAPE)
    mask[3:10, 3:21, 3:21] = mask[14:21, 3:21, 3:21] = 1
    return mask


BALL = np.linalg.norm(np.indices(SHAPE) - 11.5, axis=0) < 8


@pytest.mark.parametrize(
    ("key", "make", "message"),
    [
        ("moving", not_an_image, "bad.nii.gz cannot be read"),
        ("moving", lambda f: save(f / "bad.nii.gz", np.zeros((*SHAPE, 3))), "expected a 3D image"),
        ("moving", lambda f: save(f / "bad.nii.gz", BALL, np.diag([4, 4, 0, 1])), "affine is singular"),
        ("moving", lambda f: save(f / "bad.nii.gz", np.where(BALL, np.nan, 1)), "NaN"),
        (
            "moving",
            lambda f: save(f / "bad.nii.gz", np.ones(SHAPE)),
            "the moving image has the same intensity everywhere",
        ),
        ("labels", lambda f: save(f / "bad.nii.gz", BALL), "holds no label"),
        ("labels", lambda f: save(f / "bad.nii.gz", BALL * 0.5), "not integers"),
        ("labels", lambda f: save(f / "bad.nii.gz", np.arange(729).reshape(9, 9, 9) % 4), "covers 5% of the fixed"),
        ("intracranial", lambda f: save(f / "bad.nii.gz", two_parts()), "2 separate parts"),
        ("intracranial", lambda f: save(f / "bad.nii.gz", np.zeros(SHAPE)), "the value 0 everywhere"),
        (
            "intracranial",
            lambda f: save(f / "bad.nii.gz", 100 * np.random.default_rng(0).random(SHAPE)),
            "probabilities",
        ),
        ("labels", lambda f: save(f / "bad.nii.gz", np.arange(24**3).reshape(SHAPE) % 5), "does not list: 4 (177 ml)"),
        ("intracranial", lambda f: f / "gone.nii.gz", "no such file"),
    ],
)
def test_a_bad_file_is_named(pair, tmp_path, key, make, message):
    result = pair(**{key: str(make(tmp_path))})
    assert result.exit_code == 2, result
    assert message in result.stderr
    assert result.stderr.startswith("bayesreg: ")


def test_images_far_apart_are_named_where_their_headers_are_to_be_kept(pair, tmp_path):
    far = save(tmp_path / "far.nii.gz", BALL, nib.affines.from_matvec(4 * np.eye(3), [900, 0, 0]))
    result = pair(moving=str(far), pose="fixed")
    assert result.exit_code == 2
    assert "covers 0% of the fixed one" in result.stderr


def lone_array(folder):
    with (folder / "start.npz").open("wb") as file:
        np.save(file, np.zeros((9, 3)))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda f: (f / "start.npz").write_bytes(b"PK half"), "is damaged or no .npz file"),
        (lone_array, "is damaged or no .npz file"),
        (lambda f: np.savez(f / "start.npz", v=np.zeros((9, 3))), "expected an array named 'u', got v"),
        (lambda f: np.savez(f / "start.npz", u=np.zeros((3, 9))), "has shape (3, 9); expected (n, 3)"),
        (lambda f: np.savez(f / "start.npz", u=np.zeros(())), "has shape (); expected (n, 3)"),
        (lambda f: np.savez(f / "start.npz", u=np.full((9, 3), np.nan)), "finite numbers"),
        (lambda f: np.savez(f / "start.npz", u=np.full((9, 3), "far")), "finite numbers"),
    ],
)
def test_a_bad_start_field_is_told_before_meshing(pair, tmp_path, write, message):
    write(tmp_path)
    result = pair(start={"field": str(tmp_path / "start.npz")})
    assert result.exit_code == 2, result
    assert message in result.stderr
    assert "start.npz" in result.stderr
    assert "delete" not in result.stderr


def test_a_start_field_that_may_serve_waits_for_the_mesh(pair, tmp_path):
    np.savez(tmp_path / "start.npz", u=np.zeros((9, 3)))
    assert isinstance(pair(start={"field": str(tmp_path / "start.npz")}).exception, LongWorkError)


def test_a_sound_pair_reaches_the_long_work(pair):
    assert isinstance(pair().exception, LongWorkError)


def test_a_folder_that_holds_another_run_is_left_alone(pair, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "run.json").write_text("{}")
    result = pair("run", "-o", str(out))
    assert result.exit_code == 2
    assert str(out) in result.stderr
    assert [path.name for path in out.iterdir()] == ["run.json"]


@pytest.mark.parametrize("command", ["report", "compare"])
def test_a_folder_without_a_run(tmp_path, command):
    result = CliRunner().invoke(app, [command, *[str(tmp_path)] * (2 if command == "compare" else 1)])
    assert result.exit_code == 2
    assert "holds no run of bayesreg" in result.stderr
