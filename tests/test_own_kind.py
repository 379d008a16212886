"""A kind of observation that nobody in the package knows, from its section of the YAML to its row in the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import bayesreg as br
from bayesreg.model.observations.registry import register
from bayesreg.model.observations.section import Arrays, ObservationSection, ReportTable
from bayesreg.settings import FoundFile, Positive, Vector
from tests.phantoms import box_mesh

MEASURED, SD = np.array([1.0, -0.5, 0.2]), 0.1


# What a user writes: 40 lines.
class MeanDisplacement:
    """The mean displacement of some points, mm, was measured with an error of this sd in every coordinate."""

    kind = "region"

    def __init__(self, name: str, points: np.ndarray, measured: np.ndarray, sd: float) -> None:
        self.name, self.points, self.measured, self.sd = name, points, measured, sd

    def standardised_residual(self, state: Any) -> Any:
        return (self.measured - state.at(self.points).mean(axis=0)) / self.sd

    def log(self, state: Any) -> Any:
        return -0.5 * (self.standardised_residual(state) ** 2).sum()

    def summarise(self, posterior: Any, state: Any, draws: Any) -> dict[str, np.ndarray]:
        return {"found": np.asarray(state.at(self.points).mean(axis=0))}


@register
class RegionSection(ObservationSection):
    """The mean displacement of a region, mm."""

    title = "mean displacement of a region"

    kind: Literal["region"]
    name: str = "region"
    points: FoundFile
    measured: Vector
    sd: Positive

    def read(self) -> dict[str, np.ndarray]:
        return {"points": np.loadtxt(self.points, delimiter=",")}

    def observe(self, inputs: Any) -> list[MeanDisplacement]:
        points = inputs.observed[self.name]["points"]
        return [MeanDisplacement(self.name, points, np.array(self.measured), self.sd)]

    @classmethod
    def tables(cls, name: str, summary: Arrays) -> list[ReportTable]:
        rows = [[f"mean of {name}", *summary["found"].tolist()]]
        return [ReportTable("Mean displacement", "Of the posterior mean, mm.", ["", "x", "y", "z"], rows)]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("own-kind")
    br.save_mesh(box_mesh(2), folder / "mesh.vtu")
    points = np.array([[5.0, 6.0, 7.0], [6.0, 6.0, 8.0], [5.5, 7.0, 7.5]])
    np.savetxt(folder / "points.csv", points, delimiter=",")
    (folder / "run.yaml").write_text(
        f"""
data: {{source: files}}
mesh: {{file: mesh.vtu}}
observations:
  - {{kind: region, points: points.csv, measured: {MEASURED.tolist()}, sd: {SD}}}
model: {{preset: paper, elasticity: uniform, fixed: {{lam: 1.0, mu: 1.0}}, rigid_sd: 5.0}}
sampler: {{chains: 2, warm_up: 20}}
stop: {{max_steps: 60}}
"""
    )
    return br.run(folder / "run.yaml", out=folder / "run", progress=False)


def test_the_posterior_follows_what_was_measured(result):
    """Little else holds the box: its rigid motions are free by 5 mm."""
    region_mean = result.run.predicted.of_observation("region")["found"]
    np.testing.assert_allclose(region_mean, MEASURED, atol=3 * SD)


def test_it_has_its_row_and_its_table_in_the_report(result):
    described = result.run.manifest["observations"]["region"]
    assert (described["kind"], described["title"]) == ("region", RegionSection.title)
    assert described["values"] == 3
    page = Path(result.folder, "report.html").read_text(encoding="utf-8")
    assert RegionSection.title in page
    assert "mean of region" in page


def test_the_run_is_resumed_from_its_folder_alone(result, tmp_path):
    config = br.load_config(Path(result.folder).parent / "run.yaml", ["stop.max_steps=80"])
    (Path(result.folder).parent / "points.csv").unlink()
    again = br.run(config, out=result.folder, resume=True, progress=False)
    assert again.idata.posterior.sizes["draw"] == 80


def test_what_is_wrong_in_its_section_is_told_with_its_place(tmp_path):
    text = "data: {source: mni152}\nsimulate: {kind: paper}\nobservations: [{kind: region, measured: [1, 2], sd: -1}]\n"
    (tmp_path / "run.yaml").write_text(text)
    with pytest.raises(br.InputError) as error:
        br.load_config(tmp_path / "run.yaml")
    assert "observations.0.sd" in str(error.value)
    assert "observations.0.points: missing" in str(error.value)
    (tmp_path / "run.yaml").write_text(text.replace("region", "regions"))
    with pytest.raises(
        br.InputError, match=r"no kind of observation 'regions'; expected one of images, landmarks, surface, region"
    ):
        br.load_config(tmp_path / "run.yaml")
