"""Observations in a configuration: landmarks with images, on labels and on a mesh alone, to the report."""

import logging
import re
from contextlib import nullcontext

import jax.numpy as jnp
import numpy as np
import pytest
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg.inference.draws.inference_data import arviz
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.workflow.assembly import posterior_of
from bayesreg.workflow.fingerprint import fingerprint, require_same_observations
from bayesreg.workflow.preparation import prepared_inputs
from tests.phantoms import ball_mesh, box_mesh
from tests.reportless import without_reports
from tests.test_tissues import CENTRE, anatomy

NAMES = {"liver": 41, "vessels": 20}
SHIFT = np.array([1.0, -0.5, 0.8])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("observed")
    for name, image in zip(("fixed", "moving", "labels"), anatomy(NAMES), strict=True):
        br.save_image(image, folder / f"{name}.nii.gz")
    ball = ball_mesh(radius=38, spacing=24)
    radius = np.linalg.norm(ball.points[ball.cells].mean(axis=1) - CENTRE, axis=1)
    mesh = br.TetMesh.from_arrays(ball.points, ball.cells, (radius < 20).astype(int), tuple(NAMES))
    br.save_mesh(mesh, folder / "mesh.vtu")
    rng = np.random.default_rng(0)
    fixed = CENTRE + rng.uniform(-18, 18, (8, 3))
    moved = fixed + SHIFT + 0.2 * rng.normal(size=fixed.shape)
    rows = [f"p{k},{','.join(map(str, [*p, *q]))},0.2" for k, (p, q) in enumerate(zip(fixed, moved, strict=True))]
    header = "name,fixed_x,fixed_y,fixed_z,moving_x,moving_y,moving_z,sd"
    (folder / "pairs.csv").write_text("\n".join([header, *rows]))
    (folder / "plain.csv").write_text(re.sub(r",[^,\n]*$", "", "\n".join([header, *rows]), flags=re.MULTILINE))
    return folder


def configuration(folder, observations, data=(), name="run.yaml", **sections):
    content = {
        "data": {"source": "files", **dict(data)},
        "mesh": {"file": "mesh.vtu"},
        "observations": observations,
        "model": {
            "preset": "paper",
            "fixed": {"lam": 10.0, "mu": 1.0},
            "elastic_prior": {"kind": "boltzmann", "temperature": 50.0},
            "rigid_sd": 5.0,
        },
        "sampler": {"name": "laplace"},
        "stop": {"rhat": None, "ess": None, "max_steps": 40},
        **sections,
    }
    YAML().dump({key: value for key, value in content.items() if value is not None}, folder / name)
    return folder / name


LABELS = {"labels": "labels.nii.gz", "label_table": {"liver": 3, "vessels": 5}}
IMAGES = {"fixed": "fixed.nii.gz", "moving": "moving.nii.gz", **LABELS}
PAIRS = {"kind": "landmarks", "file": "pairs.csv", "noise": "normal"}


def test_a_mesh_alone_may_have_a_skull(folder):
    """It is that of the mask, and holds the nodes as it does with labels."""
    labels = br.load_image(folder / "labels.nii.gz")
    distance = np.linalg.norm(labels.grid_points() - CENTRE, axis=-1)
    br.save_image(labels.with_voxels((distance < 45).astype(np.uint8)), folder / "inside.nii.gz")
    skulls = []
    for data in ({}, LABELS):
        config = br.load_config(configuration(folder, [PAIRS], data | {"intracranial": "inside.nii.gz"}))
        inputs = prepared_inputs(config)[0]
        assert "skull" in posterior_of(config, inputs).data.terms
        skulls.append(inputs.skull)
    np.testing.assert_array_equal(skulls[0].voxels, skulls[1].voxels)


@pytest.mark.parametrize("data", [{}, LABELS], ids=["mesh alone", "labels"])
def test_landmarks_without_any_image(folder, tmp_path, data):
    with without_reports() if data else nullcontext():
        result = br.run(configuration(folder, [PAIRS], data), tmp_path / "out", progress=False)
    np.testing.assert_allclose(result.u_mean.mean(axis=0), SHIFT, atol=0.4)
    assert result.run.fixed is None
    assert result.run.warped is None
    assert (tmp_path / "out" / "displacement_mean.nii.gz").exists()
    assert not (tmp_path / "out" / "warped_mean.nii.gz").exists()
    predicted = store.read_run(RunFolder(tmp_path / "out")).predicted
    landmarks = predicted.of_observation("landmarks")
    assert list(landmarks["names"]) == [f"p{k}" for k in range(8)]
    np.testing.assert_allclose(landmarks["sd"], 0.2)
    fitted_error, left_out_error = (
        np.linalg.norm(landmarks[name], axis=1) for name in ("residual", "left_out_residual")
    )
    assert (left_out_error > fitted_error).all()
    assert list(result.run.manifest["observations"]) == ["landmarks"]
    if not data:
        page = result.report.read_text(encoding="utf-8")
        assert "Distances of the landmarks" in page
        assert "Posterior predictive checks" not in page
        assert "Before and after" not in page


@pytest.fixture(scope="module")
def odd_run(tmp_path_factory):
    """An organ far from the origin, in the moving image 70 mm from where it was; a point has two partners."""
    folder = tmp_path_factory.mktemp("odd")
    box = box_mesh(2, size=40.0)
    mesh = br.TetMesh.from_arrays(
        box.points + np.array([60, 20, -30]), box.cells, np.zeros(len(box.cells), int), ("organ",)
    )
    br.save_mesh(mesh, folder / "mesh.vtu")
    fixed = mesh.points[[0, 3, 7, 12, 18, 20, 25, 25]]
    moving = fixed + (70.0, 0.0, 0.0) + 12.0 * (np.arange(8) == 7)[:, None] * (0, 0, 1)
    header = "fixed_x,fixed_y,fixed_z,moving_x,moving_y,moving_z"
    np.savetxt(folder / "pairs.csv", np.hstack([fixed, moving]), delimiter=",", header=header, comments="")
    observations = [{"kind": "landmarks", "file": "pairs.csv", "sd": 1.0}]
    file = configuration(folder, observations)
    with without_reports():
        return br.run(br.load_config(file, ["model.rigid_sd=null"]), folder / "run", progress=False)


def test_what_is_odd_stands_among_the_warnings(odd_run):
    """They stand on the first page of the report."""
    sentence = "lie apart in the moving image (by how much): 7 and 8 (12 mm)"
    assert sum(sentence in warning for warning in odd_run.run.manifest["appraisal"]["warnings"]) == 1


@pytest.mark.parametrize(
    ("reading", "claim"),
    [
        (lambda grid, points: grid.world_to_voxel(points), "voxel indices of the labels; then convert them"),
        (lambda grid, points: points * (-1, -1, 1), "by which LPS and RAS differ; then state"),
        (lambda grid, points: points + np.array([70, 0, 0]), "points of the moving image; then give --inverse"),
        (lambda grid, points: points, None),
    ],
    ids=["voxels", "LPS", "moving", "as they are"],
)
def test_apply_suspects_another_reading(odd_run, tmp_path, caplog, reading, claim):
    points = reading(odd_run.run.tissue, odd_run.mesh.points)
    np.savetxt(tmp_path / "p.csv", points, delimiter=",", header="x,y,z", comments="")
    br.apply(odd_run.folder, tmp_path / "out", points=tmp_path / "p.csv", draws=30)
    suspected = [message for message in caplog.messages if "would lie in the mesh or near it" in message]
    assert len(suspected) == (claim is not None)
    assert all(claim in message for message in suspected)


def test_a_budget_that_is_spent_at_once_leaves_a_valid_folder(folder, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    stop = {"max_minutes": 1e-5, "rhat": 1.01, "ess": 400}
    file = configuration(folder, [PAIRS], stop=stop, sampler={"name": "hmc", "chains": 2})
    result = br.run(file, tmp_path / "out", progress=False)
    said = {"mode: the time is spent before the search settled", "warm-up: left out, because the time is spent"}
    assert said <= set(caplog.messages)
    stopped = result.run.manifest["stopped"]
    assert stopped["converged"] is False
    assert "s of sampling" in stopped["reason"]
    assert any("ended the search" in warning for warning in result.run.manifest["appraisal"]["warnings"])
    assert "Not converged" in result.report.read_text(encoding="utf-8")
    assert br.load_result(tmp_path / "out").u_mean.shape == result.mesh.points.shape


@pytest.mark.long
def test_landmarks_are_held_out(folder, tmp_path):
    """Points that no observation names are compared with the result, and change nothing of it."""
    table = (folder / "pairs.csv").read_text().splitlines()
    (folder / "six.csv").write_text("\n".join(table[:7]))
    (folder / "two.csv").write_text("\n".join([table[0], *table[7:], "far,200,0,0,201,0,0,0.2"]))
    observations = [{"kind": "landmarks", "file": "six.csv"}]
    with without_reports():
        plain = br.run(configuration(folder, observations, evaluation=None), tmp_path / "plain", progress=False)
    file = configuration(folder, observations, evaluation={"landmarks": "two.csv"})
    result = br.run(file, tmp_path / "out", progress=False)
    np.testing.assert_array_equal(result.idata.posterior["u_boundary"], plain.idata.posterior["u_boundary"])
    predicted = br.load_result(tmp_path / "out").run.predicted
    assert list(predicted.evaluation_names) == ["p6", "p7", "far"]
    assert predicted.evaluation_inside.tolist() == [True, True, False]
    np.testing.assert_allclose(predicted.evaluation_before[:2], np.linalg.norm(SHIFT), atol=1.0)
    after = np.linalg.norm(predicted.evaluation_residual[:2], axis=1)
    assert (after < predicted.evaluation_before[:2]).all()
    assert (np.sqrt(np.einsum("kii->ki", predicted.evaluation_covariance))[:2] >= 0.2).all()
    assert np.isnan(predicted.evaluation_covariance[2]).all()
    page = result.report.read_text(encoding="utf-8")
    assert 'id="landmarks-held-out"' in page
    assert "Target registration error" in page
    assert plain.run.predicted.evaluation_residual is None
    # They may be found later.
    with without_reports():
        later = br.run(file, tmp_path / "plain", resume=True, progress=False).run.predicted
    np.testing.assert_allclose(later.evaluation_residual, predicted.evaluation_residual, atol=1e-5)
    with pytest.raises(br.InputError, match="6 of the 6 landmarks of evaluation are in the observation"):
        br.run(
            configuration(folder, observations, evaluation={"landmarks": "six.csv"}), tmp_path / "never", progress=False
        )
    assert not (tmp_path / "never").exists()
    with pytest.raises(br.InputError, match=r"evaluation.landmarks"):
        br.load_config(configuration(folder, observations, evaluation={"landmarks": "none.csv"}))
    with pytest.raises(br.InputError, match="this name is taken"):
        br.load_config(configuration(folder, [observations[0] | {"name": "evaluation"}]))


def test_arviz_finds_what_it_knows_by_name(folder, tmp_path):
    pairs = [PAIRS | {"name": "points"}]
    with without_reports():
        idata = br.run(configuration(folder, pairs), tmp_path / "out", progress=False).idata
    assert idata.posterior["u_boundary"].attrs["units"] == "mm"
    assert idata.sample_stats["diverging"].dtype == bool
    assert {"lp", "acceptance_rate", "n_steps"} <= set(idata.sample_stats.data_vars)
    draws, observed = idata.posterior_predictive["points"], idata.observed_data["points"]
    assert draws.dims == ("chain", "draw", "points_point", "axis")
    assert observed.sizes == {"points_point": 8, "axis": 3}
    np.testing.assert_allclose(draws.mean(("chain", "draw")), observed, atol=0.6)
    # Against the density in closed form: ∏ N(q − p; u(p), sd²), up to the spread of the replicates.
    log = idata.log_likelihood["points"]
    assert log.dims == ("chain", "draw", "points_point")
    assert log.max() <= 3 * (-0.5 * np.log(2 * np.pi) - np.log(0.2)) + 1e-9
    loo = arviz().loo(idata, var_name="points")
    assert np.isfinite(float(getattr(loo, "elpd_loo", getattr(loo, "elpd", np.nan))))
    assert len(arviz().summary(idata, var_names=["lam", "mu"])) > 0


def require_images_are_predicted(result):
    """Replicated intensities of images beside landmarks, by all the ten draws, about those observed."""
    observed, draws = result.idata.observed_data, result.idata.posterior_predictive
    assert set(observed.data_vars) == set(draws.data_vars) == {"images", "vessel"}
    assert draws["images"].dims == ("chain", "draw", "images_point")
    assert draws.sizes["draw"] == 10
    assert observed["images_x"].attrs["units"] == "mm"
    places = np.stack([observed[f"images_{axis}"] for axis in "xyz"], axis=1)
    assert (places.min(axis=0) > result.mesh.points.min(axis=0)).all()
    away = (draws["images"] - observed["images"]).to_numpy()
    sd = np.sqrt((away**2).mean(axis=(0, 1)))
    # Half of the spread of f is what m does not tell.
    assert np.median(sd) < 2 * observed["images"].std()
    assert (sd > 0).all()
    assert set(result.idata.log_likelihood.data_vars) == {"vessel"}


@pytest.mark.long
def test_landmarks_with_images_and_an_inferred_sd_go_on_where_they_were_cut_off(folder, tmp_path):
    observed = [{"kind": "images"}, {"kind": "landmarks", "file": "plain.csv", "sd": {"median": 0.5}, "name": "vessel"}]
    sections = {"sampler": {"name": "laplace", "chains": 2, "block": 5}}
    stop = {"rhat": None, "ess": None}
    short = configuration(folder, observed, IMAGES, "short.yaml", **sections, stop=stop | {"max_steps": 5})
    longer = configuration(folder, observed, IMAGES, "longer.yaml", **sections, stop=stop | {"max_steps": 10})
    with without_reports():
        br.run(short, tmp_path / "out", progress=False)
        uninterrupted = br.run(longer, tmp_path / "whole", progress=False)
    result = br.run(longer, tmp_path / "out", resume=True, progress=False)
    require_images_are_predicted(result)
    assert result.idata.posterior["vessel_sd"].shape == (2, 10)
    assert (result.idata.posterior["vessel_sd"] > 0).all()
    assert list(result.run.manifest["observations"]) == ["images", "vessel"]
    assert result.run.manifest["scales"]["vessel_sd"] == {"median": 0.5, "log_sd": 1.0}
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "vessel sd, mm" in page
    assert "Posterior predictive checks" in page
    np.testing.assert_array_equal(uninterrupted.idata.posterior["vessel_sd"], result.idata.posterior["vessel_sd"])


@pytest.mark.parametrize(
    ("observations", "data", "sections", "message"),
    [
        ([{"kind": "images"}], LABELS, {}, "images are observed, and data has none"),
        ([PAIRS, PAIRS], LABELS, {}, "two observations are named landmarks"),
        ([PAIRS | {"name": "a b"}], LABELS, {}, 'observations.0.name = "a b": expected a name of letters'),
        ([PAIRS | {"name": "solver_failed"}], LABELS, {}, "this name is taken"),
        ([PAIRS | {"file": "none.csv"}], LABELS, {}, "observations.0.file"),
        ([PAIRS], LABELS | {"fixed": "fixed.nii.gz"}, {}, "a pair of images needs both"),
        ([PAIRS], {"labels": "labels.nii.gz"}, {}, "labels and label_table belong together"),
        ([PAIRS], LABELS | {"fixed_ignore": "labels.nii.gz"}, {}, "no image of which a part could be ignored"),
        ([PAIRS], {}, {"mesh": None}, "mesh.file: missing"),
        ([PAIRS], LABELS, {"report": {"landmarks": {"a": [0, 0, 0]}}}, "this key is called report.places now"),
    ],
)
def test_what_does_not_fit_is_told(folder, observations, data, sections, message):
    with pytest.raises(br.InputError, match=re.escape(message)):
        br.load_config(configuration(folder, observations, data, "wrong.yaml", **sections))


def test_landmarks_without_an_sd_have_it_inferred(folder, tmp_path):
    """The error of the points is 0.2 mm."""
    path = configuration(folder, [{"kind": "landmarks", "file": "plain.csv"}], LABELS)
    with without_reports():
        result = br.run(path, tmp_path / "out", progress=False)
    assert 0.05 < float(result.idata.posterior["landmarks_sd"].median()) < 0.8


def test_a_second_reading_tells_the_sd_and_the_run_says_both(folder, tmp_path, caplog):
    """The error of the points is 0.2 mm, that of the second reading, too."""
    caplog.set_level(logging.INFO)
    moved = br.read_point_pairs(folder / "plain.csv").moving
    again = moved + np.sqrt(2) * 0.2 * np.random.default_rng(7).normal(size=moved.shape)
    np.savetxt(tmp_path / "second.csv", again, delimiter=",", header="x,y,z", comments="")
    entry = {"kind": "landmarks", "file": "plain.csv", "second_file": str(tmp_path / "second.csv")}
    with without_reports():
        result = br.run(configuration(folder, [entry], LABELS), tmp_path / "out", progress=False)
    medians = [result.run.manifest["scales"][f"landmarks_sd_{axis}"]["median"] for axis in "xyz"]
    np.testing.assert_allclose(medians, np.sqrt(((again - moved) ** 2).mean(axis=0) / 2), rtol=1e-5)
    inferred = result.idata.posterior["landmarks_sd_x"].mean()
    told = f"an sd of {medians[0]:.2g} mm along x, .*; the run infers {inferred:.2g} mm along x, "
    assert sum(bool(re.search(told, message)) for message in caplog.messages) == 1
    assert re.search(told, result.run.manifest["appraisal"]["notes"][-1])


def test_an_entry_of_observations_is_overridden_by_its_number(folder):
    path = configuration(folder, [PAIRS, PAIRS | {"name": "other"}], LABELS)
    config = br.load_config(path, ["observations.1.sd=2.5"])
    assert [section.sd for section in config.observations] == [None, 2.5]
    with pytest.raises(br.InputError, match=r"--set observations.2.sd=1: 2 is no entry of a list of 2"):
        br.load_config(path, ["observations.2.sd=1"])
    with pytest.raises(br.InputError, match=r"--set observations.1.sd=wide: observations.1.sd = "):
        br.load_config(path, ["observations.1.sd=wide"])


class Near:
    """The first node has moved by less than a distance, mm: a log that is −∞ elsewhere."""

    name = "near"

    def __init__(self, distance):
        self.distance = distance

    def log(self, state):
        return jnp.where(jnp.abs(state.u[0]).max() < self.distance, 0.0, -jnp.inf)


def test_an_observation_that_forbids_is_known_again(tmp_path):
    """Also where its log is −∞ at the displacement at which observations are compared, which JSON writes as null."""
    posterior = {d: br.build_posterior(mesh=box_mesh(2), observations=[Near(d)]) for d in (1e-6, 100.0)}
    fingerprints = {d: fingerprint(post, [Near(d)]) for d, post in posterior.items()}
    assert fingerprints == {1e-6: {"near": None}, 100.0: {"near": 0.0}}
    for distance, built in posterior.items():
        require_same_observations(tmp_path, {"observations": fingerprints[distance]}, built, [Near(distance)])
    with pytest.raises(br.InputError, match=r"another observation 'near' .* are None and 0\.0"):
        require_same_observations(tmp_path, {"observations": fingerprints[1e-6]}, posterior[100.0], [Near(100.0)])


def test_nothing_observed_is_told(folder, tmp_path):
    with pytest.raises(br.InputError, match="nothing observed"):
        br.run(configuration(folder, None, LABELS), tmp_path / "out", progress=False)
