import base64
import io
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import PIL.Image
import pytest

from bayesreg.report import style
from bayesreg.report.html import write_report
from bayesreg.report.places import regions
from bayesreg.report.three_d import figure
from bayesreg.report.uncertainty import places_of

FIGURES = {"registration", "displacement", "places", "stiffness", "residual-images", "traces", "distributions"}
PAPER = {"data", "result", "node"}


class Page(HTMLParser):
    """Pictures, table rows, text, and whatever would be loaded from elsewhere."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.figures: dict[str, str] = {}
        self.rows: list[list[str]] = []
        self.text = ""
        self.tags: set[str] = set()
        self.links: list[str] = []
        self.raw = text
        self._script = False
        self._key = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.add(tag)
        self._script = tag == "script"
        self._key = attributes.get("id", "").removeprefix("figure-") if tag == "figure" else self._key
        if tag == "img":
            self.figures[self._key] = attributes["src"]
            assert attributes["alt"]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th") and self.rows:
            self.rows[-1].append("")
        self.links += [value for key, value in attributes.items() if key in ("href", "src") and value]

    def handle_endtag(self, tag):
        self._script = False

    def handle_data(self, data):
        if self._script:
            return
        self.text += data
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data

    def row(self, name: str) -> list[str]:
        return next(row[1:] for row in self.named(name))

    def named(self, name: str) -> list[list[str]]:
        return [row for row in self.rows if row and row[0] == name]


def page(path, study) -> Page:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "DPI", 40)
        write_report(*study, path / "report.html")
    return Page((path / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def full(tmp_path_factory, study):
    return page(tmp_path_factory.mktemp("full"), study)


@pytest.fixture(scope="module")
def clinical(tmp_path_factory, uniform_study):
    """Uniform parameters, not of the paper, not converged, no truth, no skull, and a name that is no markup."""
    run = uniform_study.run
    stopped = run.manifest["stopped"] | {"reason": "the budget of 5 min was spent. And <i>this</i>"}
    model = run.manifest["model"] | {"preset": "registration"}
    manifest = run.manifest | {"name": '<script>alert("x")</script> & Ω', "stopped": stopped, "model": model}
    run = replace(run, manifest=manifest, config="a: </pre><b>bold</b>\n", truth=None, skull=None, metrics=None)
    return page(tmp_path_factory.mktemp("clinical"), uniform_study._replace(run=run))


def test_every_figure_is_drawn_and_embedded(full):
    assert set(full.figures) == FIGURES | PAPER
    for key, uri in full.figures.items():
        kind, content = re.fullmatch(r"data:image/(png|webp|svg\+xml);base64,(.+)", uri).groups()
        content = base64.b64decode(content)
        if kind != "svg+xml":
            pixels = np.asarray(PIL.Image.open(io.BytesIO(content)).convert("RGB")) / 255
            assert pixels.shape[1] == round(style.WIDTH * 40)
            assert pixels.std() > 0.02, key
        else:
            assert content.count(b"<path") > 30, key


def test_the_page_needs_no_network(full):
    assert all(link.startswith(("#", "data:")) for link in full.links)
    assert not full.tags & {"link", "iframe"}
    assert "cdn" not in full.raw[: full.raw.index("plotly.js")]
    assert full.raw.count("plotly.js v") == 1


def test_three_dimensions_show_the_mesh_where_it_was_and_went(seen):
    run, drawn = seen.run, figure(seen)
    outer, nodes = drawn.data[0], seen.mesh.boundary
    faces = np.stack([outer.i, outer.j, outer.k], axis=1)
    np.testing.assert_array_equal(nodes[faces], seen.mesh.boundary_faces)
    after = np.stack([outer.x, outer.y, outer.z], axis=1)
    np.testing.assert_allclose(after, (seen.mesh.points + run.u_mean)[nodes], atol=0.01)
    np.testing.assert_allclose(outer.intensity, np.linalg.norm(run.u_mean, axis=1)[nodes], atol=0.001)
    steps = {step.label: step.args[0] for step in drawn.layout.sliders[0].steps}
    np.testing.assert_allclose(
        np.transpose([steps["before"][axis][0] for axis in "xyz"]), seen.mesh.points[nodes], atol=0.01
    )
    np.testing.assert_allclose(np.transpose([steps["after"][axis][0] for axis in "xyz"]), after)


def test_a_place_is_an_ellipsoid_about_where_it_goes(seen):
    place, drawn = places_of(seen)[0], figure(seen).data[1]
    away = np.stack([drawn.x, drawn.y, drawn.z], axis=1) - place.point - place.region.mean
    distance = np.einsum("ki,ij,kj->k", away, np.linalg.inv(place.region.shape), away)
    np.testing.assert_allclose(distance, 1, rtol=0.1)
    i, j, k = (np.asarray(corner) for corner in (drawn.i, drawn.j, drawn.k))
    outwards = np.cross(away[j] - away[i], away[k] - away[i])
    assert ((outwards * away[i]).sum(axis=1) > -1e-6).all()


def test_what_a_clinician_reads_first(full, study):
    run = study.run
    most = np.linalg.norm(run.u_mean, axis=1).max()
    for question in ("Did it work?", "What moved?", "How far?", "How sure?", "Where not to trust it?"):
        assert question in full.text
    assert f"the most, {most:.1f} mm" in full.text
    first = full.text[: full.text.index("Before and after")]
    assert "A fifth of the organ is ignored." in first
    assert "Where not to trust it?" in first


def test_table_1_holds_the_errors_of_the_boundary_nodes(full, study):
    run = study.run
    distance = np.linalg.norm((run.u_mean - run.truth.u)[run.mesh.boundary], axis=1)
    expected = [np.median(distance), np.quantile(distance, 0.95), distance.max()]
    assert full.row("Posterior mean") == [f"{value:.2f}" for value in expected]
    moved = np.linalg.norm(run.truth.u[run.mesh.boundary], axis=1)
    assert full.row("No motion")[2] == f"{moved.max():.2f}"
    assert full.row("Start of the chains")[2] == f"{moved.max() / 2:.2f}"


def test_table_2_holds_the_integrated_errors(full, study):
    run = study.run
    error = run.u_mean - run.truth.u
    rng = np.random.default_rng(0)
    shares = rng.dirichlet(np.ones(4), 4000)
    # Monte Carlo over every cell: uniform points in a simplex.
    inside = np.array([((shares @ error[cell]) ** 2).sum(axis=1).mean() for cell in run.mesh.cells])
    weights = run.mesh.volumes
    written = [float(text) for text in full.named("Posterior mean")[1][1:]]
    expected = [np.average(inside, weights=weights)]
    expected += [np.average(inside[run.mesh.tissue == k], weights=weights[run.mesh.tissue == k]) for k in range(3)]
    np.testing.assert_allclose(written, expected, rtol=0.02)


def test_the_papers_numbers_stand_beside(full):
    assert [row[1:] for row in full.named("By tissue")] == [
        ["0.16", "0.72", "2.43"],
        ["0.040", "0.049", "0.049", "0.023"],
    ]
    assert full.row("Initial configuration") == ["2.56", "8.24", "15.08"]


def test_parameters_with_intervals_truth_and_what_is_fixed(full, study):
    ratio = study.idata.posterior["lam"].isel(tissue=2) / study.idata.posterior["mu"].isel(tissue=2)
    wm = full.named("λ/μ")[2]
    assert wm[1] == f"{float(ratio.median()):.1f}"
    assert wm[-1] == "30.0"
    assert full.named("μ")[-2][2] == "fixed"


def test_the_worst_estimands_are_named_with_their_place(full, study):
    rhat = study.rhat["u_boundary"]
    node, axis = np.unravel_index(int(np.argmax(rhat.data)), rhat.shape)
    x, y, z = study.run.mesh.points[int(rhat["node"][node])].round().astype(int)
    row = full.row(f"u{'xyz'[axis]} of node {int(rhat['node'][node])}")
    assert row[0] == f"({x}, {y}, {z}) mm".replace("-", "−")
    assert row[1] == regions(study.run.mesh, study.run.mesh.points[[int(rhat["node"][node])]])[0]
    assert row[2] == f"{float(rhat.max()):.3f}"


def test_verdict_warnings_settings_and_convention_are_told(full):
    assert "Converged: R̂ is below 1.01 for all 563 estimands" in full.text
    assert "24.3 %" in full.text
    assert full.row("Acceptance in all") == ["8.7 %"]
    assert "Neurological convention" in full.text
    assert "elasticity: tissue" in full.text
    assert "How to cite" in full.text


def test_without_truth_and_skull_the_page_is_whole(clinical):
    assert set(clinical.figures) == FIGURES | {"modes"}
    assert "Table 1" not in clinical.text
    assert "Figures of the paper" not in clinical.text


def test_names_reasons_and_config_are_text_not_markup(clinical):
    assert '<script>alert("x")</script> & Ω' in clinical.text
    assert "And <i>this</i>" in clinical.text
    assert "a: </pre><b>bold</b>" in clinical.text
    assert not clinical.tags & {"i", "b"}
    assert "<script>alert" not in clinical.raw


def test_chains_that_did_not_converge_are_called_so(clinical):
    assert "Not converged: R̂ is 1.01 or more for" in clinical.text
    assert "It stopped because the budget of 5 min was spent." in clinical.text
    assert "parameters uniform" in clinical.text


def test_places_are_listed_with_their_region_and_name_as_text(full, study):
    predicted = study.run.predicted
    row = full.row("tip <b>")
    draws = predicted.place_draws[:, :, 1].reshape(-1, 3)
    assert row[2] == ", ".join(f"{x:.1f}" for x in draws.mean(axis=0)).replace("-", "−")
    # The draws are Normal with these sds: the radius of 95 % is the root of a chi-square quantile.
    expected = np.sqrt(7.815) * np.array([0.9, 0.3, 0.1])
    np.testing.assert_allclose([float(x) for x in row[4].split(" × ")], expected, rtol=0.15)


def test_the_checks_name_what_the_model_does_not_explain(full):
    sd = full.row("sd of the residual")
    assert sd[0].startswith("1.30 (")
    assert sd[2:] == ["p < 0.0033", "too much"]
    assert full.row("greatest |residual|")[3] == "as the model has it"


def test_a_page_with_one_group_of_chains_and_another_preset_lacks_those_sections(full, clinical):
    assert "Chains that disagree" not in full.text
    assert "#chains-that-disagree" not in full.links
    assert "#figures-of-the-paper" in full.links
    assert "#figures-of-the-paper" not in clinical.links
    assert "Paper" not in [cell for row in clinical.rows for cell in row]


def test_separate_chains_and_an_approximate_sampler_are_told_first(tmp_path, study):
    """Chain 3 five standard deviations apart in all of one side, and draws of an approximation."""
    posterior = study.idata.posterior.copy(deep=True)
    right = study.run.mesh.points[posterior["node"].to_numpy()][:, 0] > 20
    posterior["u_boundary"][2, :, right, 1] += 5.0
    shifted = np.zeros((3, *study.run.u_mean.shape))
    shifted[2, study.run.mesh.points[:, 0] > 20, 1] = 5.0
    predicted = study.run.predicted._replace(chain_mean=study.run.u_mean + shifted)
    manifest = study.run.manifest | {"exact": False, "sampler": {"name": "laplace"}}
    run = replace(study.run, predicted=predicted, manifest=manifest)
    report_page = page(tmp_path, study._replace(run=run, idata=study.idata._replace(posterior=posterior)))
    assert "group 1: chains 1, 2; group 2: chain 3" in report_page.text
    assert "several modes" in report_page.text
    assert "The chains lie in 2 groups, each shown" in report_page.text
    assert set(report_page.figures) == FIGURES | PAPER | {"modes"}
    assert report_page.text.index("Approximate: a quick look") < report_page.text.index("Converged")


def test_names_from_anywhere_are_shown_as_they_are(study, tmp_path):
    """None is markup, a script or a formula to the page and its figures."""
    tissues = ("<script>alert(1)</script>", "$x_{$", "a & b \\frac{")
    mesh = replace(study.run.mesh, names=tissues)
    names = ["$x_{$", "</script><script>alert(2)</script>", *study.run.predicted.place_names[2:]]
    landmarks = {
        "points/names": np.array(["$x_{$", "$\\frac$ <b>"]),
        "points/points": mesh.points[:2],
        "points/sd": np.ones(2),
        "points/residual": np.ones((2, 3)),
    }
    observations = {**study.run.predicted.observations, **landmarks}
    predicted = study.run.predicted._replace(place_names=np.array(names), observations=observations)
    posterior = study.idata.posterior.assign_coords(tissue=list(tissues))
    described = {"points": {"kind": "landmarks", "title": "pairs of points", "log": 0.0}}
    manifest = study.run.manifest | {
        "name": "<img src=x onerror=alert(3)> $x_{$",
        "observations": study.run.manifest["observations"] | described,
    }
    run = replace(study.run, mesh=mesh, predicted=predicted, manifest=manifest, metrics=None)
    figures = [dataset.assign_coords(tissue=list(tissues)) for dataset in (study.rhat, study.ess_bulk, study.ess_tail)]
    write_report(run, study.idata._replace(posterior=posterior), *figures, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "<img src=x" not in text
    page = Page(text)
    assert "b" not in page.tags
    for name in (*tissues, *names[:2], *landmarks["points/names"]):
        assert name in page.text or any(name in cell for row in page.rows for cell in row), name
