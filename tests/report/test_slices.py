import numpy as np
import pytest

from bayesreg.image import Image
from bayesreg.report.slices import MeshSlice, Plane, planes_through, sample
from tests.phantoms import ball_mesh, linear_image, rotated_affine


def test_fields_on_a_plane_are_exact_where_they_are_linear():
    mesh = ball_mesh(40.0, 18.0)
    plane = Plane(0, 7.0, (-60.0, 50.0), (-40.0, 60.0), 1.0)
    matrix = np.random.default_rng(0).normal(size=(3, 3))
    sliced = MeshSlice(mesh, plane)
    picture, points = sliced.nodal(mesh.points @ matrix.T), plane.points()
    assert picture.shape == points.shape == (100, 110, 3)
    np.testing.assert_allclose(picture[sliced.inside], points[sliced.inside] @ matrix.T, atol=1e-9)
    assert np.isnan(picture[~sliced.inside]).all()
    assert sliced.inside.sum() == pytest.approx(np.pi * (40**2 - 7**2), rel=0.1)


def test_cellwise_fields_name_the_cell_of_each_pixel():
    mesh = ball_mesh(40.0, 24.0)
    plane = Plane(2, 5.0, (-40.0, 50.0), (-50.0, 40.0), 2.0)
    sliced = MeshSlice(mesh, plane)
    cells = sliced.cellwise(np.arange(len(mesh.cells)))
    row, column = np.argwhere(sliced.inside)[300]
    corner = mesh.points[mesh.cells[int(cells[row, column])]]
    weights = np.linalg.solve(np.vstack([corner.T, np.ones(4)]), [*plane.points()[row, column], 1.0])
    assert weights.min() > -1e-9


def test_pictures_lie_the_right_way_round_whatever_the_grid():
    """A bright spot at the right, front and top shows right of the centre, and towards the upper edge."""
    spot = np.array([20.0, 30.0, 25.0])
    corners = np.array([[-40.0, -50, -35], [40, 50, 35]])
    grid = Image(np.zeros((60, 70, 50)), rotated_affine(corners, (60, 70, 50), left_handed=True))
    image = grid.with_voxels(np.exp(-((grid.grid_points() - spot) ** 2).sum(axis=-1) / 50))
    for axis, (across, up) in enumerate(((1, 2), (0, 2), (0, 1))):
        plane = Plane(axis, spot[axis], (-50.0, 50.0), (-50.0, 50.0), 1.0)
        picture = sample(image, plane.points(), outside=0.0)
        row, column = np.unravel_index(picture.argmax(), picture.shape)
        # imshow with the origin below puts row 0 at the bottom edge.
        assert plane.vertical[0] + row + 0.5 == pytest.approx(spot[up], abs=1.5)
        assert plane.horizontal[0] + column + 0.5 == pytest.approx(spot[across], abs=1.5)


def test_sampling_is_linear_inside_and_says_what_lies_outside():
    points = ball_mesh(40.0, 24.0).points
    image = linear_image(points, (0.1, -0.2, 0.3), 2.0)
    np.testing.assert_allclose(sample(image, points), 2 + points @ (0.1, -0.2, 0.3), atol=1e-9)
    assert np.isnan(sample(image, np.array([[1e4, 0, 0]]))).all()
    assert (sample(image, np.array([[1e4, 0, 0]]), outside=-7.0) == -7).all()


def test_labels_are_sampled_without_mixing():
    image = Image(np.array([0, 5, 0]).reshape(3, 1, 1), np.eye(4))
    labels = sample(image, np.array([[0.4, 0, 0], [0.6, 0, 0], [1.4, 0, 0], [1.6, 0, 0]]), order=0)
    np.testing.assert_array_equal(labels, [0, 5, 5, 0])


def test_planes_pass_through_an_inner_point_and_leave_one_that_would_only_graze():
    mesh = ball_mesh(40.0, 13.0)
    inner = np.array([4.0, -10.0, 12.0])
    assert [plane.position for plane in planes_through(mesh, inner)] == pytest.approx(inner)
    top = mesh.points[mesh.points[:, 2].argmax()]
    sagittal, coronal, axial = planes_through(mesh, top)
    assert sagittal.position == pytest.approx(top[0])
    assert coronal.position == pytest.approx(top[1])
    # 60 % of the area of the largest section lies at √0.4 of the radius; edges of 13 mm blur that by half of one.
    assert axial.position == pytest.approx(np.sqrt(0.4) * 40, abs=6.6)


def test_titles_name_the_plane_with_a_proper_minus():
    assert Plane(2, -12.3, (0.0, 1.0), (0.0, 1.0), 1.0).title == "axial, z = −12 mm"
    assert Plane(0, -0.2, (0.0, 1.0), (0.0, 1.0), 1.0).title == "sagittal, x = 0 mm"
