"""Bodies that tell what a mesh does to λ/μ, and the table that widens a run's by them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bayesreg as br
from bayesreg.io.atomic import read_json
from bayesreg.model.observations.images.options import ImageOptions
from bayesreg.results.result import Result
from studies.mesh_error import __main__ as module
from studies.mesh_error import bodies as bodies_module
from studies.mesh_error.__main__ import mesh_error
from studies.mesh_error.bodies import Body, Subject, register_body
from studies.mesh_error.ratios import enough
from tests.phantoms import PAPER_LAM, PAPER_MU, ball_mesh
from tests.report.conftest import make_study
from tests.synthetic.test_pair import head

NAMES = ("csf", "gm", "wm")
OPTIONS = ImageOptions(similarity=br.StudentT(temperature=0.3), interpolation="cubic")


def fake(_subject: Subject, seed: int) -> Body:
    """A mesh that halves the λ/μ it finds; the search for one body fails."""
    rng = np.random.default_rng(seed)
    true, error = np.exp(rng.uniform(0.7, 4.6, 2)), np.exp(0.1 * rng.normal(size=2))
    true, estimated = (dict(zip(NAMES[1:], values.tolist(), strict=True)) for values in (true, true * error / 2))
    return Body(seed, true, {}, "it folds") if seed == 3 else Body(seed, true, estimated)


@pytest.fixture(scope="module")
def study():
    phantom_study = make_study(draws=100, spacing=18.0)
    images = {"kind": "images", "noise_sd": 0.0146, "options": OPTIONS.model_dump(mode="json")}
    manifest = {**phantom_study.run.manifest, "observations": {"images": images}}
    return phantom_study._replace(run=replace(phantom_study.run, manifest=manifest))


def result_of(folder, run, study):
    """A result whose draws stand in no file."""
    result = Result(folder, run)
    result.__dict__["idata"] = study.idata
    return result


@pytest.fixture
def folder(study, tmp_path, monkeypatch):
    """The folder of the study, with a finer mesh at hand."""
    br.save_mesh(ball_mesh(spacing=13.0), tmp_path / "finer.vtu")
    monkeypatch.setattr(module, "load_result", lambda run: result_of(Path(run), study.run, study))
    monkeypatch.setattr(module, "register_body", fake)
    return tmp_path


def subject_of(**options) -> Subject:
    phantom = head(2.5)
    values = (dict(zip(NAMES, parameters.tolist(), strict=True)) for parameters in (PAPER_LAM, PAPER_MU))
    images = {"similarity": br.SquaredDifferences(temperature=1e-3), "interpolation": "cubic"}
    model = br.ModelConfig(**options)
    return Subject(
        phantom.fixed, phantom.tissue, phantom.skull, phantom.mesh, phantom.mesh, model, images, *values, 7.0, 1e-4
    )


def test_on_the_mesh_that_made_a_body_its_registration_finds_its_ratio():
    """That of WM: GM is the shell of this ball, almost without a node that is not sampled."""
    body = register_body(subject_of(), seed=1)
    assert body.failed == ""
    assert body.found["wm"] == pytest.approx(body.true["wm"], rel=0.2)


@pytest.mark.parametrize("known", [{"mu": {"gm": 1.0}}, {"lam": {"gm": 5.0}}, {"mu": {"gm": 1.0}, "lam": {"gm": 5.0}}])
def test_bodies_have_the_parameters_that_the_registration_knows(known, monkeypatch):
    attempts = []

    def refuse(*_images, lam, mu, **_push):
        attempts.append((lam, mu))
        raise br.InputError("it folds")

    monkeypatch.setattr(bodies_module, "make_pair", refuse)
    body = register_body(subject_of(fixed=known), seed=1)
    assert body.failed == "no patch can be pushed by 7.0 mm; the last attempt: it folds"
    lam, mu = (dict(zip(NAMES, values.tolist(), strict=True)) for values in attempts[0])
    for parameter, values in (("lam", lam), ("mu", mu)):
        for name, value in known.get(parameter, {}).items():
            assert values[name] == pytest.approx(value)
    assert (lam["csf"], mu["csf"]) == (PAPER_LAM[0], PAPER_MU[0])
    assert body.true == pytest.approx({name: lam[name] / mu[name] for name in body.true})
    assert ("gm" in body.true) == (known != {"mu": {"gm": 1.0}, "lam": {"gm": 5.0}})


def test_the_table_and_the_figure_allow_for_the_mesh(folder, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["mesh_error", "run", "-o", str(folder), "--bodies", "20"])
    module.main()
    shown = " ".join(capsys.readouterr().out.split())
    assert "GM, allowing for it" in shown
    assert "19 bodies of known" in shown
    assert "1 more is left out" in shown
    assert (folder / "ratios.svg").read_text().count("<path") > 20


def test_bodies_are_kept_and_more_are_added(folder, monkeypatch):
    seeds = []

    def asking(subject: Subject, seed: int) -> Body:
        seeds.append(seed)
        assert ImageOptions(**subject.image_options) == OPTIONS
        return fake(subject, seed)

    monkeypatch.setattr(module, "register_body", asking)
    mesh_error("run", folder, 13, progress=False)
    table = mesh_error("run", folder, 24, progress=False)
    assert seeds == list(range(24))
    ((_, rows),) = table.groups
    on_it, allowing = ({row[0][:2]: float(row[3]) for row in rows[first::2]} for first in (0, 1))
    for tissue in ("GM", "WM"):
        # The mesh halves what it finds.
        assert allowing[tissue] == pytest.approx(2 * on_it[tissue], rel=0.15)


def test_nothing_is_told_where_too_few_are_registered(folder, monkeypatch):
    monkeypatch.setattr(module, "register_body", lambda _, seed: Body(seed, {"gm": 9.0, "wm": 9.0}, {}, "why"))
    with pytest.raises(br.InputError, match="only 0 of 12 bodies are registered, 12 are needed; why"):
        mesh_error("run", folder, 12, progress=False)
    assert not enough(read_json(folder / "bodies.json"))
    assert not (folder / "ratios.svg").exists()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"skull": None}, "inside the skull"),
        ({"boundary": np.zeros((3, 3))}, "must not be held"),
        ({"config": "model: {elastic_prior: {held: {0: [0.0, 0.0, 0.0]}}}"}, "must not be held"),
        ({"config": "model: {elasticity: uniform}"}, "elasticity: tissue"),
        ({"config": "model: {fixed: {lam: 9.0, mu: 1.0}}"}, "elasticity: tissue"),
        ({"manifest": {"observations": {"images": {}}, "inverted_elements": 2}}, "inside out"),
        ({"manifest": {"observations": {"images": {}, "landmarks": {}}}}, "observed images, landmarks"),
        ({"mesh": ("csf", "fluid", "FLUID")}, "and a solid tissue"),
    ],
)
def test_what_has_no_ratio_of_its_own_is_refused(folder, study, monkeypatch, changed, message):
    if "mesh" in changed:
        mesh = study.run.mesh
        changed = {"mesh": br.TetMesh.from_arrays(mesh.points, mesh.cells, mesh.tissue, changed["mesh"])}
    broken = result_of(folder, replace(study.run, **changed), study)
    monkeypatch.setattr(module, "load_result", lambda run: broken)
    with pytest.raises(br.InputError, match=message):
        mesh_error("run", folder, progress=False)
    assert not (folder / "bodies.json").exists()


def test_too_few_bodies_are_refused(folder):
    with pytest.raises(br.InputError, match="bodies must be at least 12, got 11"):
        mesh_error("run", folder, 11, progress=False)
