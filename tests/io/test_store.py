from dataclasses import fields, replace

import nibabel as nib
import numpy as np
import pytest
import pyvista

from bayesreg.image import Image
from bayesreg.io import checkpoints, store
from bayesreg.io.intensities import in_levels
from bayesreg.io.records import Inputs, Predicted, Run, Truth
from bayesreg.io.run_folder import RunFolder
from tests.phantoms import ball_mesh, rotated_affine


@pytest.fixture
def run():
    rng = np.random.default_rng(0)
    mesh = ball_mesh(40.0, 30.0)
    shape, n = (7, 6, 5), len(mesh.points)
    affine = rotated_affine(mesh.points, shape)
    images = {name: in_levels(Image(rng.normal(size=shape), affine)) for name in ("fixed", "moving", "warped")}
    return Run(
        config="sampler:\n  step: 1e-3 # λ\n",
        manifest={"seed": 3, "stopped": {"converged": False, "reason": "budget"}},
        mesh=mesh,
        u_mean=rng.normal(size=(n, 3)),
        u_sd=rng.uniform(size=(n, 3)),
        tissue=Image(rng.integers(0, 4, shape).astype(np.int8), affine),
        skull=Image(rng.uniform(size=shape) > 0.5, affine),
        truth=Truth(rng.normal(size=(n, 3)), np.array([1e-6, 10.0, 30.0]), np.ones(3), rng.normal(size=(n, 3))),
        metrics={"boundary_error": {"max": 2.5}},
        **images,
    )


def inputs_of(run: Run) -> Inputs:
    return Inputs(**{name: getattr(run, name) for name in Inputs._fields})


def write(folder, run: Run, mean=None, sd=None) -> None:
    """All of a run, as the program writes it; displacements are zero where none are given."""
    zero = np.zeros((*run.fixed.shape, 3))
    with RunFolder(folder).writing("prepared") as place:
        store.write_inputs(place, inputs_of(run))
    with RunFolder(folder).writing("finished") as place:
        store.write_results(place, run, zero if mean is None else mean, zero if sd is None else sd)


def assert_same(a: Run, b: Run) -> None:
    assert (a.config, a.manifest, a.metrics) == (b.config, b.manifest, b.metrics)
    assert a.mesh.digest == b.mesh.digest
    np.testing.assert_array_equal(a.u_mean, b.u_mean)
    np.testing.assert_array_equal(a.u_sd, b.u_sd)
    for name in (field.name for field in fields(Run)):
        first_value, second_value = getattr(a, name), getattr(b, name)
        if isinstance(first_value, Image):
            np.testing.assert_array_equal(first_value.voxels, second_value.voxels, err_msg=name)
            np.testing.assert_allclose(first_value.affine, second_value.affine, atol=1e-4, err_msg=name)


def test_a_run_comes_back_as_it_was_written(run, tmp_path):
    folder = tmp_path / "new" / "run"
    write(folder, run)
    read_run = store.read_run(RunFolder(folder))
    assert_same(run, read_run)
    for written_array, read_array in zip(run.truth, read_run.truth, strict=True):
        np.testing.assert_array_equal(written_array, read_array)


def test_predictions_come_back_with_names_and_shapes(run, tmp_path):
    arrays = {name: np.arange(k + 2.0) for k, name in enumerate(Predicted._fields) if name != "observations"}
    by_cell = ("stiffness_mean", "stiffness_sd", "stiffer_probability")
    arrays |= {name: np.linspace(0, k + 1.0, len(run.mesh.cells)) for k, name in enumerate(by_cell)}
    observations = {"images/residual": np.arange(3.0), "points/names": np.array(["a", "b"])}
    names = {"place_names": np.array(["third ventricle", "λ"]), "observations": observations}
    write(tmp_path, replace(run, predicted=Predicted(**arrays | names)))
    predicted = store.read_run(RunFolder(tmp_path)).predicted
    assert list(predicted.place_names) == ["third ventricle", "λ"]
    np.testing.assert_array_equal(predicted.reach, arrays["reach"])
    np.testing.assert_array_equal(predicted.of_observation("images")["residual"], np.arange(3.0))
    assert predicted.of_observation("points")["names"].tolist() == ["a", "b"]
    stored = pyvista.read(tmp_path / "mesh.vtu").cell_data
    for name in by_cell:
        np.testing.assert_array_equal(stored[name], arrays[name])


def test_truth_skull_and_metrics_may_be_missing(run, tmp_path):
    run = replace(run, truth=None, skull=None, metrics=None)
    write(tmp_path, run)
    read_run = store.read_run(RunFolder(tmp_path))
    assert_same(run, read_run)
    assert read_run.truth is None
    assert read_run.skull is None
    assert read_run.metrics is None
    assert read_run.predicted is None


def test_a_truth_without_a_start_comes_back_without(run, tmp_path):
    write(tmp_path, replace(run, truth=run.truth._replace(initial=None)))
    assert store.read_run(RunFolder(tmp_path)).truth.initial is None


def test_displacements_are_written_as_lps_transform_and_the_sd_stays_positive(run, tmp_path):
    mean = np.zeros((*run.fixed.shape, 3))
    mean[2, 3, 1] = (1.0, 2.0, 3.0)
    write(tmp_path, run, mean, np.abs(mean))
    for name, expected in (("displacement_mean", (-1.0, -2.0, 3.0)), ("displacement_sd", (1.0, 2.0, 3.0))):
        file = nib.load(tmp_path / f"{name}.nii.gz")
        assert file.shape == (*run.fixed.shape, 1, 3)
        assert file.header["intent_code"] == 1007
        np.testing.assert_allclose(np.asarray(file.dataobj)[2, 3, 1, 0], expected)
        np.testing.assert_allclose(file.affine, run.fixed.affine, atol=1e-4)


def test_inputs_can_be_read_before_the_run_has_finished(run, tmp_path):
    with RunFolder(tmp_path).writing("prepared") as place:
        store.write_inputs(place, inputs_of(run))
    inputs = store.read_inputs(RunFolder(tmp_path))
    assert inputs.config == run.config
    assert inputs.mesh.digest == run.mesh.digest
    np.testing.assert_array_equal(inputs.truth.u, run.truth.u)
    with pytest.raises(ValueError, match=r"has not ended; .*--resume"):
        store.read_run(RunFolder(tmp_path))


@pytest.mark.parametrize(
    "name", ["run.json", "config.yaml", "mesh.vtu", "inputs/fixed.nii.gz", "inputs/tissue.nii.gz", "warped_mean.nii.gz"]
)
def test_each_missing_part_is_named(run, tmp_path, name):
    write(tmp_path, run)
    (tmp_path / name).unlink()
    with pytest.raises(ValueError, match=f"holds no whole run: {name} is missing"):
        store.read_run(RunFolder(tmp_path))


def test_a_mesh_without_results_is_no_finished_run(run, tmp_path):
    write(tmp_path, run)
    with RunFolder(tmp_path).writing() as place:
        store.save_mesh(run.mesh, place("mesh.vtu"))
    with pytest.raises(ValueError, match="holds no u_mean and no u_sd"):
        store.read_run(RunFolder(tmp_path))


def test_blocks_come_back_in_order_and_can_be_replaced(tmp_path):
    folder = RunFolder(tmp_path)
    assert list(checkpoints.StoredBlocks(folder, 0)) == []
    for k in range(12):
        checkpoints.save_block(folder, k, {"u": np.full((2, 3), float(k)), "step": np.array(k)})
    checkpoints.save_block(folder, 11, {"u": np.full((2, 3), -1.0), "step": np.array(11)})
    blocks = checkpoints.StoredBlocks(folder, 12)
    assert [int(block["step"]) for block in blocks] == list(range(12))
    assert (blocks[11]["u"] == -1).all()
    assert len(blocks) == 12
    fewer = checkpoints.StoredBlocks(folder, 5)
    fewer.append({"step": np.array(50)})
    assert [int(block["step"]) for block in fewer] == [0, 1, 2, 3, 4, 50]
    with pytest.raises(IndexError, match="block 6 of 6"):
        fewer[6]


def test_a_process_killed_while_writing_a_block_loses_that_block_only(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path)
    checkpoints.save_block(folder, 0, {"u": np.zeros(3)})
    checkpoints.save_state(folder, {"step": np.array(1)})

    def killed(file, **_):
        file.write(b"PK half a file")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", killed)
    with pytest.raises(KeyboardInterrupt):
        checkpoints.save_block(folder, 1, {"u": np.ones(3)})
    with pytest.raises(KeyboardInterrupt):
        checkpoints.save_state(folder, {"step": np.array(2)})
    assert [path.name for path in (tmp_path / "draws").iterdir()] == ["block_00000.npz"]
    assert int(checkpoints.load_state(folder)["step"]) == 1


def test_a_gap_among_the_blocks_is_an_error(tmp_path):
    folder = RunFolder(tmp_path)
    for k in (0, 2):
        checkpoints.save_block(folder, k, {"u": np.zeros(1)})
    with pytest.raises(ValueError, match=r"block_00001\.npz is missing"):
        checkpoints.StoredBlocks(folder, 3)


@pytest.mark.parametrize("name", ["state.npz", "draws/block_00000.npz", "inputs/truth.npz"])
def test_a_damaged_checkpoint_names_the_way_on(run, tmp_path, name):
    folder = RunFolder(tmp_path)
    write(tmp_path, run)
    checkpoints.save_block(folder, 0, {"u": np.zeros(3)})
    checkpoints.save_state(folder, {"step": np.array(1)})
    (tmp_path / name).write_bytes(b"PK half a file")
    read = {
        "state.npz": checkpoints.load_state,
        "draws/block_00000.npz": lambda f: list(checkpoints.StoredBlocks(f, 1)),
        "inputs/truth.npz": store.read_inputs,
    }
    with pytest.raises(ValueError, match=f"{name} is damaged, or was changed .*; run anew, into another folder"):
        read[name](folder)


def test_without_a_checkpoint_there_is_no_state(tmp_path):
    with pytest.raises(ValueError, match=r"status\.json is missing"):
        checkpoints.load_state(RunFolder(tmp_path))
