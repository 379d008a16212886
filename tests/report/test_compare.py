from dataclasses import replace

import numpy as np
import pytest

from bayesreg.report import style
from bayesreg.report.compare import write_comparison
from tests.report.conftest import make_study
from tests.report.test_html import Page


@pytest.fixture(scope="module")
def other(study):
    """Uniform parameters on the same pair, with twice the error."""
    uniform = make_study(seed=1, uniform=True, memory=0.995, draws=60)
    run = replace(
        study.run, manifest=uniform.run.manifest, u_mean=2 * study.run.u_mean - study.run.truth.u, metrics=None
    )
    return uniform._replace(run=run)


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    monkeypatch.setattr(style, "DPI", 40)


def compare(path, studies) -> Page:
    write_comparison(studies, path / "compare.html")
    return Page((path / "compare.html").read_text(encoding="utf-8"))


def test_two_runs_beside_one_another_and_beside_the_paper(tmp_path, study, other):
    page = compare(tmp_path, [study, other])
    assert set(page.figures) == {"maps", "ratios", "distributions"}
    assert "By tissue against Uniform" in page.text
    run = study.run
    distance = np.linalg.norm((run.u_mean - run.truth.u)[run.mesh.boundary], axis=1)
    assert page.named("By tissue")[0][1] == f"{np.median(distance):.2f}"
    assert page.named("Uniform")[0][1] == f"{2 * np.median(distance):.2f}"
    assert page.named("By tissue")[1][1:] == ["0.16", "0.72", "2.43"]
    assert len(page.named("No motion")) == 2
    assert "Converged" in page.text
    assert "Not converged" in page.text
    assert "Beware" not in page.text
    assert all(link.startswith(("#", "data:")) for link in page.links)


def test_runs_without_truth_and_of_one_name(tmp_path, clinical_study):
    run = replace(clinical_study.run, manifest={"name": "<Anna>"})
    page = compare(tmp_path, [clinical_study._replace(run=run)] * 3)
    assert "<Anna> (1), <Anna> (2), <Anna> (3)" in page.text
    assert "Table 1" not in page.text


def test_unequal_pairs_and_meshes_are_told(tmp_path, study):
    foreign = make_study(seed=7, spacing=16.0, draws=30, shape=(30, 36, 24))
    page = compare(tmp_path, [study, foreign])
    assert "not of one pair" in page.text
    assert "different meshes" in page.text


def test_one_run_is_no_comparison(tmp_path, study):
    with pytest.raises(ValueError, match="two or more runs, got 1"):
        write_comparison([study], tmp_path / "compare.html")


def test_an_approximate_run_is_told_by_name(tmp_path, study, other):
    run = replace(other.run, manifest=other.run.manifest | {"exact": False, "sampler": {"name": "laplace"}})
    page = compare(tmp_path, [study, other._replace(run=run)])
    assert "Uniform is approximate. The draws come from laplace" in page.text
    assert "By tissue is approximate" not in page.text
