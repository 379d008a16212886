"""`bayesreg register`: what it understands of paths alone, and what it says before it begins."""

from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import nibabel as nib
import numpy as np
import pytest
from typer.testing import CliRunner

from bayesreg.cli import app
from bayesreg.io import readers
from bayesreg.label_tables import TABLES
from bayesreg.workflow import meshing, preparation
from bayesreg.workflow.register import understand
from tests.phantoms import ball_mesh

SHAPE = (24, 20, 16)


@pytest.fixture
def register(tmp_path, monkeypatch):
    """Calls the command with files of a pair; what it would run is kept in `calls`."""
    calls = []

    def run(config, out, resume=False, progress=True):
        calls.append((config, out, resume, progress))
        return SimpleNamespace(converged=True, folder=out)

    monkeypatch.setattr("bayesreg.workflow.run.run", run)
    voxels = np.random.default_rng(0).normal(size=SHAPE).astype(np.float32)
    labels = (np.arange(np.prod(SHAPE)).reshape(SHAPE) % 4).astype(np.uint8)
    for name, content in {
        "fixed": voxels,
        "moving": voxels,
        "labels": labels,
        "odd": labels * 30,
        "mask": labels > 0,
    }.items():
        nib.save(
            nib.Nifti1Image(content.astype(np.float32), np.diag([1.0, 1.0, 2.5, 1.0])), tmp_path / f"{name}.nii.gz"
        )

    def call(*arguments):
        paths = [str(tmp_path / f"{name}.nii.gz") for name in ("fixed", "moving")]
        return CliRunner().invoke(app, ["register", *paths, *arguments, "-o", str(tmp_path / "out")])

    return SimpleNamespace(call=call, calls=calls, path=lambda name: str(tmp_path / f"{name}.nii.gz"), folder=tmp_path)


def test_paths_are_enough_and_what_was_understood_is_said_first(register):
    result = register.call("--labels", register.path("labels"), "--intracranial", register.path("mask"))
    assert result.exit_code == 0, result.output
    config, out, _, progress = register.calls[0]
    assert (out, progress) == (register.folder / "out", True)
    assert config.data.label_table == TABLES["fast"]
    assert str(config.data.intracranial) == register.path("mask")
    assert config.model.preset == "registration"
    lines = result.output.splitlines()
    assert lines[0].endswith("fixed.nii.gz: 24 × 20 × 16 voxels of 1 × 1 × 2.5 mm")
    assert "fast, which fits the values, as brats2023 would (--table): csf 1; gm 2; wm 3" in result.output
    assert lines[-1] == f"Report: {register.folder / 'out' / 'report.html'}"


def test_a_table_is_named_or_lies_in_a_file(register):
    (register.folder / "table.yaml").write_text("{csf: 30, brain: [60, 90]}")
    result = register.call("--labels", register.path("odd"), "--table", str(register.folder / "table.yaml"), "-q")
    assert result.exit_code == 0, result.output
    assert register.calls[0][0].data.tissues == ("csf", "brain")
    assert register.call("--labels", register.path("labels"), "--table", "brainweb").exit_code == 0
    assert register.calls[1][0].data.label_table == TABLES["brainweb"]


def test_options_are_set_as_in_run(register):
    register.call("--labels", register.path("labels"), "--set", "stop.max_minutes=3", "--set",
                  "observations.0.similarity=lncc", "--set", "observations.0.intensity_map=null")  # fmt: skip
    config = register.calls[0][0]
    assert (config.stop.max_minutes, config.image_options.similarity.kind) == (3, "lncc")


def test_a_quick_look_ends_at_the_approximation(register):
    result = register.call("--quick", "--set", "stop.max_steps=7")
    config = register.calls[0][0]
    assert (config.sampler.name, config.stop.rhat, config.stop.max_steps) == ("laplace", None, 7)
    assert "sampler     laplace, approximate" in result.output


def test_what_is_said_is_what_was_set(register):
    result = register.call("--labels", register.path("labels"), "--set", f"data.intracranial={register.path('mask')}",
                           "--set", "data.label_table={csf: 1, gm: [2, 3]}")  # fmt: skip
    assert f"mask        {register.path('mask')}" in result.output
    assert "csf 1; gm 2, 3" in result.output


def test_images_alone_are_enough(register):
    result = register.call()
    assert result.exit_code == 0, result.output
    assert register.calls[0][0].data.tissues == ("organ",)
    assert (
        "labels      none: the organ is what is bright in the fixed image and in view of the moving one, of one tissue"
        in result.output
    )


def test_an_unknown_pose_of_images_needs_no_prior_of_rigid_motions(register):
    result = register.call("--labels", register.path("labels"), "--set", "data.pose=unknown")
    assert result.exit_code == 0, result.output
    assert register.calls[0][0].model.rigid_sd is None


def test_a_mask_is_the_organ_where_there_are_no_labels(register):
    result = register.call("--intracranial", register.path("mask"))
    assert f"none: the organ is all of {register.path('mask')}" in result.output
    assert register.calls[0][0].data.label_table is None


def test_masks_say_of_which_image_they_are(register):
    mask = register.path("mask")
    result = register.call("--labels", register.path("labels"), "--fixed-ignore", mask, "--moving-ignore", mask)
    assert f"ignored     what is not zero in {mask} says nothing, in the moving image" in result.output
    data = register.calls[0][0].data
    assert (str(data.fixed_ignore), str(data.moving_ignore)) == (mask, mask)


def test_labels_may_be_probabilities(register):
    shares = np.random.default_rng(0).dirichlet(np.ones(3), SHAPE).astype(np.float32)
    nib.save(nib.Nifti1Image(shares, np.diag([1.0, 1.0, 2.5, 1.0])), register.folder / "shares.nii.gz")
    result = register.call("--labels", register.path("shares"))
    assert result.exit_code == 0, result.output
    assert "fast, which fits the values, as brats2023 would (--table)" in result.output


def test_a_mask_of_any_two_values_serves_as_labels(register):
    voxels = np.zeros(SHAPE, np.uint8)
    voxels[1:-1, 1:-1, 1:-1] = 255
    nib.save(nib.Nifti1Image(voxels, np.diag([1.0, 1.0, 2.5, 1.0])), register.folder / "organ.nii.gz")
    result = register.call("--labels", register.path("organ"))
    assert result.exit_code == 0, result.output
    assert register.calls[0][0].data.label_table == {"organ": (255,)}


def test_a_table_that_was_set_is_said_to_be(register):
    result = register.call("--labels", register.path("labels"), "--set", "data.label_table={gm: 1, wm: [2, 3]}")
    assert "table       as set: gm 1; wm 2, 3" in result.output


def test_a_table_without_labels_is_a_mistake(register):
    result = register.call("--table", "fast")
    assert result.exit_code == 2
    assert "give --labels, too" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["odd"], "no label table fits the labels in"),
        (["odd", "--table", "fats"], "--table fats: neither a file nor one of fast, freesurfer, brainweb"),
        (["gone"], "there is no such file"),
        (["labels", "--set", "stop.max_hours=3"], "what was asked for cannot be run"),
    ],
)
def test_a_mistake_is_one_message(register, arguments, message):
    result = register.call("--labels", register.path(arguments[0]), *arguments[1:])
    assert result.exit_code == 2, result.output
    assert message in result.stderr
    assert not register.calls


def test_further_images_are_compared_as_well(register):
    channel = [register.path("fixed"), register.path("moving")]
    result = register.call("--labels", register.path("labels"), *["--channel", ",".join(channel)] * 2)
    assert result.exit_code == 0, result.output
    first, second, third = register.calls[0][0].observations
    assert (first.name, second.name, third.name) == ("images", "channel_2", "channel_3")
    assert (str(second.fixed), str(second.moving)) == (str(third.fixed), str(third.moving)) == tuple(channel)
    assert "channel_2" in result.output
    assert "expected two paths" in register.call("--channel", channel[0]).stderr


def test_the_voxels_of_a_file_are_read_once(tmp_path, monkeypatch):
    """From its paths to the inputs of a run; a second time where labels have to say by which table they are meant."""
    radius = np.linalg.norm(np.indices((24, 24, 24)) - 11.5, axis=0)
    labels, image = np.where(radius < 9, 1.0, 0.0), np.random.default_rng(0).normal(12 - radius, 0.1)
    contents = {
        "fixed": image,
        "moving": image,
        "a,b": image,
        "labels": labels,
        "mask": radius < 11,
        "cavity": radius < 2,
    }
    path = {name: tmp_path / f"{name}.nii.gz" for name in contents}
    for name, voxels in contents.items():
        nib.save(nib.Nifti1Image(np.asarray(voxels, np.float32), np.eye(4)), path[name])
    counts, read = Counter(), readers._voxels

    def counting(source, path):
        counts[path.name.removesuffix(".nii.gz")] += 1
        return read(source, path)

    monkeypatch.setattr(readers, "_voxels", counting)
    monkeypatch.setattr(meshing, "build_mesh", lambda *_: ball_mesh(radius=8, spacing=6))
    pair = f"{path['a,b']},{path['a,b']}"
    understood = understand(
        path["fixed"], path["moving"], path["labels"], None, path["mask"], path["cavity"], path["cavity"],
        [pair], ["data.pose=fixed"],
    )  # fmt: skip
    assert counts == {"labels": 1}
    preparation.prepare(understood.config)
    assert counts == {"fixed": 1, "moving": 1, "labels": 2, "mask": 1, "cavity": 2, "a,b": 2}


def test_a_surface_needs_no_images(register, tmp_path):
    points = tmp_path / "laser.csv"
    points.write_text("x,y,z\n" + "\n".join(f"{k},1,2" for k in range(12)))
    config = understand(labels=Path(register.path("labels")), surfaces=[points]).config
    assert [(section.kind, section.file) for section in config.observations] == [("surface", points)]
    assert (config.model.elasticity, config.model.rigid_sd) == ("uniform", 1.0)
    both = understand(labels=Path(register.path("labels")), surfaces=[points], landmarks=[points]).config
    assert [section.kind for section in both.observations] == ["landmarks", "surface"]
    assert both.model.rigid_sd is None
    lost = understand(labels=Path(register.path("labels")), surfaces=[points], overrides=["data.pose=unknown"])
    assert lost.config.model.rigid_sd == 10.0
    assert "pose        looked for by the surface, each rigid motion to 10 mm (model.rigid_sd)" in lost.lines
    images = [Path(register.path(name)) for name in ("fixed", "moving")]
    assert understand(*images, surfaces=[points], overrides=["data.pose=unknown"]).config.model.rigid_sd is None


def test_points_need_no_images(register):
    pairs = register.folder / "pairs.csv"
    pairs.write_text("fixed_x,fixed_y,fixed_z,moving_x,moving_y,moving_z\n1,2,3,4,5,6\n")
    arguments = ["--labels", register.path("labels"), "--landmarks", str(pairs)]
    result = CliRunner().invoke(app, ["register", *arguments, "-o", str(register.folder / "out")])
    assert result.exit_code == 0, result.output
    config = register.calls[0][0]
    assert [section.kind for section in config.observations] == ["landmarks"]
    assert (config.data.fixed, config.model.preset) == (None, "registration")
    assert f"landmarks   {pairs}" in result.output
    assert "pose" not in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fixed"], "is one image; give FIXED and MOVING"),
        ([], "nothing is observed; give two images, --landmarks or --surface"),
        (["--landmarks", "mask"], "without images, --labels says where the organ is"),
    ],
)
def test_what_is_missing_is_told(register, arguments, message):
    paths = [argument if argument.startswith("--") else register.path(argument) for argument in arguments]
    result = CliRunner().invoke(app, ["register", *paths, "-o", str(register.folder / "out")])
    assert result.exit_code == 2
    assert message in result.stderr
