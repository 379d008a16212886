"""A mesh that does not lie where the labels are is told before anything long begins, with what would make it fit."""

import numpy as np
import pytest

import bayesreg as br
from bayesreg.io.agreement import require_agreement
from bayesreg.mesh import TetMesh
from tests.phantoms import ball_mesh, save_grid


@pytest.fixture(scope="module")
def given():
    """Labels of two halves and a pole of a ball off the origin, and a mesh of them."""
    affine = np.diag([-2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = np.array([5.0, -3.0, 8.0]) + np.array([50.0, -50.0, -50.0])
    grid = br.Image(np.zeros((51, 51, 51)), affine)

    def label(points):
        away = points - np.array([5.0, -3.0, 8.0])
        return np.where(
            np.linalg.norm(away, axis=-1) > 41, 0, np.select([away[..., 2] > 15, away[..., 0] > 4], [3, 2], 1)
        )

    ball = ball_mesh(spacing=13.0)
    tissue = label(ball.points[ball.cells].mean(axis=1)) - 1
    return TetMesh(ball.points, ball.cells, tissue, ball.names), grid.with_voxels(label(grid.grid_points()))


def test_a_mesh_of_the_labels_agrees(given):
    require_agreement(*given, "mesh.vtu")


@pytest.mark.parametrize(
    ("points", "order", "message"),
    [
        (lambda x: x / 1000, [0, 1, 2], r"in m \(write it in mm\)$"),
        (lambda x: x / 10, [0, 1, 2], r"in cm \(write it in mm\)$"),
        (lambda x: x * (-1, -1, 1), [0, 1, 2], r"with x and y reversed \(it may be in LPS: write it in RAS\)$"),
        (lambda x: x * (1, 1, -1), [0, 1, 2], "with z reversed$"),
        (lambda x: x, [2, 1, 0], "with its tissues numbered as wm, gm, csf and not as csf, gm, wm$"),
        (lambda x: x + 200, [0, 1, 2], "in no more than 0% of its volume; give a mesh of these labels"),
        (
            lambda x: x * (-0.001, -0.001, 0.001),
            [1, 0, 2],
            "in m .* and with x and y reversed .* and with its tissues numbered as gm, csf, wm",
        ),
    ],
)  # fmt: skip
def test_a_mesh_that_lies_elsewhere_is_told(given, points, order, message):
    mesh, labels = given
    moved = TetMesh(points(mesh.points), mesh.cells, np.array(order)[mesh.tissue], mesh.names)
    if (moved.volumes < 0).all():
        moved = TetMesh(moved.points, mesh.cells[:, [1, 0, 2, 3]], moved.tissue, mesh.names)
    with pytest.raises(br.InputError, match=message):
        require_agreement(moved, labels, "mesh.vtu")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x / 1000, r"% in m \(write it in mm\)$"),
        (lambda x: x * (-1, -1, 1), r"% with x and y reversed \(it may be in LPS: write it in RAS\)$"),
        (lambda x: x + 25, "in no more than .*% of its volume; give a mesh of these labels"),
    ],
)
def test_of_readings_that_agree_about_as_well_the_most_usual_is_told(change, message):
    """Shells are much the same reversed."""
    centre = np.array([5.0, -3.0, 8.0])
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = centre - 50
    grid = br.Image(np.zeros((51, 51, 51)), affine)

    def label(points):
        return np.select([(away := np.linalg.norm(points - centre, axis=-1)) < 20, away < 32, away < 41], [3, 2, 1], 0)

    ball = ball_mesh(spacing=9.0)
    tissue = label(ball.points[ball.cells].mean(axis=1)) - 1
    labels = grid.with_voxels(label(grid.grid_points()))
    require_agreement(TetMesh(ball.points, ball.cells, tissue, ball.names), labels, "mesh.vtu")
    with pytest.raises(br.InputError, match=message):
        require_agreement(TetMesh(change(ball.points), ball.cells, tissue, ball.names), labels, "mesh.vtu")


def test_a_tetrahedron_that_is_there_twice_is_told(tmp_path):
    mesh = ball_mesh(spacing=30.0)
    cells = np.concatenate([mesh.cells, mesh.cells[[7]][:, [1, 2, 0, 3]]])
    tissue = np.append(mesh.tissue, 0)
    save_grid(tmp_path / "twice.vtu", mesh.points, cells, tissue)
    with pytest.raises(br.InputError, match="twice"):
        br.load_mesh(tmp_path / "twice.vtu")
    # A node more, far beyond an inner face: three tetrahedra share it.
    faces = [cell[[k for k in range(4) if k != opposite]] for cell in mesh.cells for opposite in range(4)]
    inner = next(face for face in faces if sum(set(face) <= set(cell) for cell in mesh.cells.tolist()) == 2)
    points, corners = np.vstack([mesh.points, [200.0, 0.0, 0.0]]), [*inner, len(mesh.points)]
    cells[-1] = (
        corners if np.linalg.det(points[corners[1:]] - points[corners[0]]) > 0 else [corners[k] for k in (1, 0, 2, 3)]
    )
    save_grid(tmp_path / "three.vtu", points, cells, tissue)
    with pytest.raises(br.InputError, match="more than two tetrahedra share the face"):
        br.load_mesh(tmp_path / "three.vtu")
