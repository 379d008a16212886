"""Bodies that tell what a mesh does to λ/μ, and the command that widens a run's by them."""

import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

import bayesreg as br
from bayesreg import discretisation, pipeline
from bayesreg.cli import app
from bayesreg.discretisation import Body, Subject, mesh_error, register_body
from bayesreg.inference.recalibration import response
from tests.model.test_simulation import head
from tests.phantoms import PAPER_LAM, PAPER_MU, ball_mesh
from tests.test_pipeline import anatomy, finished, folder  # noqa: F401

NAMES = ("csf", "gm", "wm")


def fake(_subject: Subject, seed: int) -> Body:
    """A mesh that halves the λ/μ it finds; the search for one body fails."""
    rng = np.random.default_rng(seed)
    true, error = np.exp(rng.uniform(0.7, 4.6, 2)), np.exp(0.1 * rng.normal(size=2))
    found = true * error / 2
    return Body(seed, dict(zip(NAMES[1:], true, strict=True)), dict(zip(NAMES[1:], found, strict=True)), int(seed == 3))


@pytest.fixture
def run(finished, folder, tmp_path):  # noqa: F811
    """A run of one's own, with a finer mesh at hand."""
    copy = tmp_path / "run"
    shutil.copytree(folder / "out", copy)
    br.save_mesh(ball_mesh(radius=38, spacing=13.0), copy / "inputs" / "finer.vtu")
    return copy


def subject_of(**options) -> Subject:
    given = head(2.5)
    values = (dict(zip(NAMES, known.tolist(), strict=True)) for known in (PAPER_LAM, PAPER_MU))
    model = br.ModelConfig(t_similarity=1e-3, interpolation="cubic", **options)
    return Subject(given.fixed, given.tissue, given.skull, given.mesh, given.mesh, model, *values, 7.0, 1e-4)


def test_on_the_mesh_that_made_a_body_its_registration_finds_its_ratio():
    """That of WM: GM is the shell of this ball, almost without a node that is not sampled."""
    body = register_body(subject_of(), seed=1)
    assert body.inverted == 0
    assert body.found["wm"] == pytest.approx(body.true["wm"], rel=0.2)


@pytest.mark.parametrize("known", [{"mu": {"gm": 1.0}}, {"lam": {"gm": 5.0}}, {"mu": {"wm": 2.0}, "lam": {"gm": 5.0}}])
def test_bodies_have_the_parameters_that_the_registration_knows(known, monkeypatch):
    made = []

    def refuse(*_images, lam, mu, **_push):
        made.append((lam, mu))
        raise br.InputError("it folds")

    monkeypatch.setattr(discretisation, "make_pair", refuse)
    with pytest.raises(br.InputError, match=r"no patch can be pushed by 7\.0 mm; the last attempt: it folds"):
        register_body(subject_of(fixed=known), seed=1)
    lam, mu = (dict(zip(NAMES, values.tolist(), strict=True)) for values in made[0])
    for parameter, values in (("lam", lam), ("mu", mu)):
        for name, value in known.get(parameter, {}).items():
            assert values[name] == pytest.approx(value)
    assert (lam["csf"], mu["csf"]) == (PAPER_LAM[0], PAPER_MU[0])
    assert 2 <= lam["gm"] / mu["gm"] <= 100


def test_the_report_of_a_run_allows_for_its_mesh(run, monkeypatch):
    monkeypatch.setattr(discretisation, "register_body", fake)
    done = CliRunner().invoke(app, ["mesh-error", str(run), "--bodies", "20", "-q"])
    assert done.exit_code == 0, done.output
    assert "GM, allowing for it" in done.output
    page = (run / "report.html").read_text()
    assert "λ/μ, allowing for the mesh" in page
    assert "19 bodies of known λ/μ" in page
    assert "1 more is left out" in page
    assert len(br.load_result(run).run.bodies) == 20


def test_bodies_are_kept_and_more_are_added(run, monkeypatch):
    asked = []
    monkeypatch.setattr(
        discretisation, "register_body", lambda subject, seed: asked.append(seed) or fake(subject, seed)
    )
    mesh_error(run, 8, progress=False)
    table = mesh_error(run, 12, progress=False)
    assert asked == list(range(12))
    ((_, rows),) = table.groups
    own, wide = (np.array([float(x) for x in row[1:]]) for row in rows[2:])
    known = [fake(None, seed) for seed in range(12) if seed != 3]
    curve = response(*(np.array([list(getattr(body, key).values()) for body in known]) for key in ("true", "found")))
    assert (curve.slope.diagonal() > 1).all()
    assert wide[2] > own[2]


def test_what_has_no_ratio_of_its_own_is_refused(run, monkeypatch):
    with pytest.raises(br.InputError, match="bodies must be at least 6, got 5"):
        mesh_error(run, 5, progress=False)
    (run / "inputs" / "skull.nii.gz").unlink()
    with pytest.raises(br.InputError, match="inside the skull"):
        mesh_error(run, progress=False)
    with pytest.raises(br.InputError, match="holds no finished run"):
        mesh_error(run / "inputs", progress=False)
    config = br.load_config(run / "config.yaml", ["model.elasticity=uniform"])
    monkeypatch.setattr(discretisation, "load_config", lambda _: config)
    with pytest.raises(br.InputError, match="elasticity: tissue"):
        mesh_error(run, progress=False)
    assert not (run / "bodies.json").exists()
    assert pipeline.load_result(run).run.bodies is None
