"""Tissues of any name and number, from the table of labels to the report; no other place names those of a brain."""

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg.io.domain import domain_labels, mesh_domain
from bayesreg.io.surfaces import tissue_surfaces
from bayesreg.tissues import BRAIN, colours_of, is_fluid, label_of, tissue_of_unit_mu, usual_value
from tests.phantoms import ball_mesh

PACKAGE = Path(br.__file__).parent
CENTRE = np.array([5.0, -3.0, 8.0])
# The names that may stand in the package, and where.
ALLOWED = {"tissues.py", "label_tables.py", "io/datasets.py"}
SHELLS = {
    "five": {"gm": 41, "wm": 34, "oedema": 27, "tumour": 20, "csf": 13},
    "one": {"prostate": 41},
    "liver": {"liver": 41, "vessels": 20},
}


def test_no_other_place_names_the_tissues_of_a_brain():
    named = re.compile(r"\b(csf|gm|wm)\b", re.IGNORECASE)
    sources = {str(path.relative_to(PACKAGE)): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    naming = {path for path, source in sources.items() if named.search(source)}
    assert naming == ALLOWED


def test_what_names_tell():
    assert [is_fluid(name) for name in ("csf", "CSF", "fluid", "liver")] == [True, True, True, False]
    assert [label_of(name) for name in ("gm", "GM", "liver")] == ["GM", "GM", "liver"]
    assert tissue_of_unit_mu(BRAIN) == "gm"
    assert tissue_of_unit_mu(("fluid", "liver", "vessels")) == "liver"
    assert tissue_of_unit_mu(("fluid",)) == "fluid"
    assert (usual_value("lam", "vessels"), usual_value("mu", "vessels"), usual_value("mu", "csf")) == (10.0, 1.0, 0.01)
    assert len(set(colours_of((*BRAIN, "a", "b", "c", "d", "e", "f")))) == 9


def anatomy(names: dict[str, float], seed: int = 0) -> tuple[br.Image, br.Image, br.Image]:
    """Nested balls: fixed, moving (0.8 mm aside), and labels 3, 5, 7, …, the first tissue outermost."""
    affine = np.diag([4.0, 4.0, 4.0, 1.0])
    affine[:3, 3] = CENTRE - 50
    grid = br.Image(np.zeros((26, 26, 26)), affine)

    def labels_at(points):
        radius = np.linalg.norm(points - CENTRE, axis=-1)
        return np.array([sum(radius < r for r in names.values())]).reshape(radius.shape)

    noise = np.random.default_rng(seed).normal(size=(2, *grid.shape))
    points = grid.grid_points()
    images = [
        grid.with_voxels(100 + 60.0 * labels_at(points + shift) + 5 * image_noise)
        for shift, image_noise in zip((np.zeros(3), np.array([0.0, 0.8, 0.0])), noise, strict=True)
    ]
    index = labels_at(points)
    return *images, grid.with_voxels(np.where(index > 0, 1 + 2 * index, 0).astype(np.int16))


@pytest.fixture(
    scope="module", params=["liver", *(pytest.param(name, marks=pytest.mark.long) for name in ("five", "one"))]
)
def case(request, tmp_path_factory):
    """The names, and a run on files with a report; that of the liver makes its own mesh."""
    names, folder = SHELLS[request.param], tmp_path_factory.mktemp(request.param)
    for name, image in zip(("fixed", "moving", "labels"), anatomy(names), strict=True):
        br.save_image(image, folder / f"{name}.nii.gz")
    config = {
        "data": {
            "source": "files",
            **{name: f"{name}.nii.gz" for name in ("fixed", "moving", "labels")},
            "label_table": {name: 3 + 2 * index for index, name in enumerate(names)},
        },
        "sampler": {"name": "rwmh", "chains": 2, "thin": 2, "block": 4, "sigma_u": 0.02},
        "stop": {"rhat": 1.2, "ess": None, "max_steps": 16},
        "model": {"preset": "paper", "rigid_sd": 5.0},
        "start": {"lam": {list(names)[-1]: 20.0}},
    }
    if request.param == "liver":
        config["mesh"] = {"edge_length": 22.0}
    else:
        ball = ball_mesh(radius=38)
        middle = ball.points[ball.cells].mean(axis=1)
        radius = np.linalg.norm(middle - CENTRE, axis=1)
        tissue = sum((radius < r).astype(int) for r in list(names.values())[1:]) + np.zeros(len(middle), int)
        br.save_mesh(br.TetMesh.from_arrays(ball.points, ball.cells, tissue, tuple(names)), folder / "mesh.vtu")
        config["mesh"] = {"file": "mesh.vtu"}
    YAML().dump(config, folder / "run.yaml")
    return tuple(names), br.run(folder / "run.yaml", folder / "out", progress=False)


def test_the_draws_have_the_names_of_the_table(case):
    names, result = case
    posterior = xr.open_dataset(result.folder / "posterior.nc", group="posterior")
    assert tuple(posterior.tissue.values) == names == result.mesh.names
    assert set(result.mesh.tissue) == set(range(len(names)))
    reference = names.index(tissue_of_unit_mu(names))
    assert (posterior.mu[..., reference] == 1).all()
    lam = posterior.lam.mean(("chain", "draw")).values
    usual = [usual_value("lam", name) for name in names[:-1]]
    np.testing.assert_allclose(lam, [*usual, 20.0], rtol=0.6)


def test_the_report_names_every_tissue(case):
    names, result = case
    page = re.sub("data:[^\"']*", "", (result.folder / "report.html").read_text(encoding="utf-8"))
    # The program that draws the three dimensions holds every word.
    page = re.sub("<script.*?</script>", "", page, flags=re.DOTALL)
    for name in names:
        assert label_of(name) in page
        assert f"middle of {label_of(name)}" in page
    if "csf" not in names:
        assert not re.search(r"\bbrain\b|\bCSF\b|\bGM\b", page)


def test_a_liver_has_its_vessels_inside():
    """The surface of the vessels lies in that of the liver; both have the volume of their labels."""
    tissue = anatomy(SHELLS["liver"])[2]
    labels = tissue.with_voxels(np.where(tissue.voxels > 0, (tissue.voxels - 1) // 2, 0).astype(np.int8))
    names = tuple(SHELLS["liver"])
    outer, inner = tissue_surfaces(domain_labels(labels, mesh_domain(labels, names=names), names), 15.0, names)
    for surface, radius in ((outer, 41), (inner, 20)):
        assert surface.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.12)
        assert np.linalg.norm(surface.points - CENTRE, axis=1).max() < radius + 3


def test_without_a_fluid_a_hole_is_the_nearest_tissue():
    voxels = np.zeros((9, 9, 9), np.int8)
    voxels[1:8, 1:8, 1:8] = 1
    voxels[4, 4, 4] = 0
    voxels[4, 4, 5] = 2
    tissue = br.Image(voxels, np.diag([1.0, 1.0, 3.0, 1.0]))
    domain = mesh_domain(tissue, names=("liver", "vessels"))
    assert domain.voxels.sum() == 7**3
    labels = domain_labels(tissue, domain, ("liver", "vessels"))
    # The vessel beside it is three millimetres away, the liver one.
    assert labels.voxels[4, 4, 4] == 1


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "expected at least one tissue with its labels"),
        ({"liver": 0}, "label_table has liver as the label 0: what no label names inside the mask of the organ"),
        ({"left lobe": 1}, "'left lobe' is no name of a tissue"),
        ({"liver": [1, 2], "vessels": 2}, "label 2 belongs to liver already, and cannot belong to vessels"),
        ({"liver": 1.5}, "data.label_table.liver"),
    ],
)
def test_tables_that_say_nothing_are_refused(tmp_path, table, message):
    for name in ("fixed", "moving", "labels"):
        (tmp_path / f"{name}.nii").touch()
    data = {"source": "files", **{name: f"{name}.nii" for name in ("fixed", "moving", "labels")}, "label_table": table}
    YAML(typ="safe").dump({"data": data}, tmp_path / "run.yaml")
    with pytest.raises(br.InputError, match=re.escape(message)):
        br.load_config(tmp_path / "run.yaml")
