"""Deformations of a mesh and of what surrounds it, there and back, against closed forms and against one another."""

import numpy as np
import pytest

from bayesreg.fem.deformation import Deformer
from bayesreg.fem.surroundings import surround
from bayesreg.mesh import TetMesh, faces_across, signed_volumes
from tests.phantoms import ball_mesh, box_mesh


def _smooth(points, size):
    """A displacement of a few mm without folds."""
    x, y, z = points.T / 30
    return size * np.stack([np.sin(x + y), np.cos(y - 2 * z), np.sin(z) * np.cos(x)], axis=1)


def _around(mesh, count, margin, seed=0):
    low, high = mesh.points.min(axis=0) - margin, mesh.points.max(axis=0) + margin
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def _creased():
    """A box with a jagged slit that narrows to an edge."""
    box = box_mesh(5, size=40.0)
    middle = box.points[box.cells].mean(axis=1)
    keep = np.abs(middle[:, 0] - 20) > 0.35 * (middle[:, 2] - 18)
    used, index = np.unique(box.cells[keep], return_inverse=True)
    return TetMesh.from_arrays(box.points[used], index.reshape(-1, 4), box.tissue[keep], box.names)


MESHES = {"ball": lambda: ball_mesh(spacing=13.0), "box": lambda: box_mesh(3), "crease": _creased}


@pytest.mark.parametrize("name", MESHES)
def test_surroundings_fill_the_sphere_and_no_more(name):
    mesh = MESHES[name]()
    surroundings = surround(mesh)
    volumes = signed_volumes(surroundings.points, surroundings.cells)
    assert (volumes > 0).all()
    cell_count = len(mesh.cells)
    np.testing.assert_array_equal(surroundings.cells[:cell_count], mesh.cells)
    sphere = surroundings.points[-400:]
    radius = np.linalg.norm(sphere - surroundings.centre, axis=1)
    np.testing.assert_allclose(radius, radius[0])
    hull = 4 / 3 * np.pi * radius[0] ** 3
    assert 0.96 * hull < volumes.sum() < hull
    # Conforming: every face of the mesh's boundary, or what it was cut into, has a tetrahedron on its other side.
    across = faces_across(surroundings.cells)
    if name != "crease":
        inner = np.concatenate([mesh.points[mesh.boundary_faces].mean(axis=1)])
        both = Deformer(mesh)
        outwards = both.locate(inner + 1e-3 * (inner - surroundings.centre))
        assert (outwards.cell >= cell_count).all()
    assert (across[:cell_count] >= -1).all()


@pytest.mark.parametrize("name", MESHES)
def test_the_displacement_goes_on_without_a_jump(name):
    mesh = MESHES[name]()
    deformer = Deformer(mesh)
    displaced = deformer.displaced(_smooth(mesh.points, 3.0))
    corner = mesh.points[mesh.boundary_faces]
    rng = np.random.default_rng(0)
    share = rng.dirichlet(np.ones(3), len(corner))
    on = np.einsum("ka,kai->ki", share, corner)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    values = [displaced.displacement(p, deformer.locate(p)) for p in (on - 1e-6 * normal, on + 1e-6 * normal)]
    jump = np.linalg.norm(values[0] - values[1], axis=1)
    assert np.median(jump) < 1e-5
    assert jump.max() < (0.5 if name == "crease" else 1e-5)


def test_a_rigid_motion_goes_on_as_it_is():
    mesh = ball_mesh()
    turn, shift = np.array([0.01, -0.02, 0.015]), np.array([3.0, -1.0, 2.0])
    everywhere = _around(mesh, 500, 120.0)
    deformer = Deformer(mesh)
    displaced = deformer.displaced(shift + np.cross(turn, mesh.points))
    location = deformer.locate(everywhere)
    assert deformer.is_inside(location).any()
    assert (location.cell < 0).any()
    displacement = displaced.displacement(everywhere, location)
    np.testing.assert_allclose(displacement, shift + np.cross(turn, everywhere), atol=1e-9)
    np.testing.assert_allclose(displaced.sources(everywhere + displacement)[0], everywhere, atol=1e-9)


def test_what_is_not_rigid_dies_away_harmonically():
    """A ball whose surface moves outwards moves what is r from its centre as its radius over r, squared, or nearly."""
    mesh = ball_mesh(spacing=9.0)
    centre = np.array([5.0, -3.0, 8.0])
    direction = np.array([[0.6, 0.8, 0.0]])
    deformer = Deformer(mesh)
    displaced = deformer.displaced(0.1 * (mesh.points - centre))
    for distance in (44.0, 55.0, 65.0):
        point = centre + distance * direction
        displacement = displaced.displacement(point, deformer.locate(point))[0]
        # Zero on the sphere of twice the radius: a r + b / r² in each direction.
        b = 4.0 / (1 / 40**2 - 40 / 80**3)
        expected = b / distance**2 - b / 80**3 * distance
        np.testing.assert_allclose(displacement @ direction[0], expected, atol=0.5)  # of 4 mm, by tetrahedra as large
        assert np.linalg.norm(displacement - displacement @ direction[0] * direction[0]) < 0.2


def test_an_affine_displacement_and_its_inverse_are_exact_inside():
    mesh = box_mesh(3)
    slope, offset = np.array([[0.1, 0.02, 0], [-0.05, 0.2, 0.1], [0.0, 0.1, -0.1]]), np.array([3.0, -2.0, 1.0])
    u, inner = mesh.points @ slope.T + offset, np.random.default_rng(0).uniform(0, 20, (500, 3))
    deformer = Deformer(mesh)
    location, displaced = deformer.locate(inner), deformer.displaced(u)
    assert deformer.is_inside(location).all()
    np.testing.assert_allclose(displaced.displacement(inner, location), inner @ slope.T + offset, atol=1e-12)
    points, _ = displaced.sources(inner + inner @ slope.T + offset)
    np.testing.assert_allclose(points, inner, atol=1e-12)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("size", [0.5, 2.0])
def test_places_come_from_where_they_were(name, size):
    mesh = MESHES[name]()
    points, deformer = _around(mesh, 4000, 40.0), Deformer(mesh)
    displaced, location = deformer.displaced(_smooth(mesh.points, size)), deformer.locate(points)
    assert displaced.folded == 0
    inside = deformer.is_inside(location)
    assert 0.005 < inside.mean() < 0.9
    places = points + displaced.displacement(points, location)
    sources, source_location = displaced.sources(places)
    error = np.linalg.norm(sources - points, axis=1)
    assert error[inside].max() < 1e-6
    assert (error > 1e-6).mean() < 0.01
    # Where tetrahedra around the mesh fold, the source is another one of the same place.
    again = sources + displaced.displacement(sources, source_location)
    assert (np.linalg.norm(again - places, axis=1) > 1e-6).mean() < 0.002


def test_steps_from_near_by_lead_where_a_search_leads():
    mesh, rng = ball_mesh(spacing=13.0), np.random.default_rng(1)
    places, deformer = _around(mesh, 3000, 10.0), Deformer(mesh)
    mean = _smooth(mesh.points, 2.0)
    _, near = deformer.displaced(mean).sources(places)
    perturbed = deformer.displaced(mean + 0.3 * rng.standard_normal(mean.shape))
    searched, at_search = perturbed.sources(places)
    stepped, at_steps = perturbed.sources(places, near)
    alike = (deformer.is_inside(at_search) == deformer.is_inside(at_steps)).mean()
    assert alike > 0.999
    np.testing.assert_allclose(stepped[deformer.is_inside(at_steps)], searched[deformer.is_inside(at_steps)], atol=1e-6)
    again = stepped + perturbed.displacement(stepped, at_steps)
    np.testing.assert_allclose(again, places, atol=1e-3)


def test_a_fold_is_counted_and_places_in_it_come_from_an_upright_tetrahedron():
    mesh = box_mesh(3)
    node = mesh.interior[0]
    u = np.zeros_like(mesh.points)
    about = np.unique(mesh.cells[(mesh.cells == node).any(axis=1)])
    far = about[np.linalg.norm(mesh.points[about] - mesh.points[node], axis=1).argmax()]
    u[node] = 1.3 * (mesh.points[far] - mesh.points[node])
    deformer = Deformer(mesh)
    displaced = deformer.displaced(u)
    assert displaced.folded > 0
    places = np.random.default_rng(0).uniform(0.5, 19.5, (2000, 3))
    points, location = displaced.sources(places)
    np.testing.assert_allclose(points + displaced.displacement(points, location), places, atol=1e-9)
    _, near = deformer.displaced(0 * u).sources(places)
    stepped, location = displaced.sources(places, near)
    np.testing.assert_allclose(stepped + displaced.displacement(stepped, location), places, atol=1e-9)


def test_what_lies_across_a_face():
    mesh = box_mesh(2)
    for cell, row in enumerate(faces_across(mesh.cells)):
        for corner, neighbour in enumerate(row):
            face = set(mesh.cells[cell]) - {mesh.cells[cell, corner]}
            holders = [k for k in range(len(mesh.cells)) if face <= set(mesh.cells[k]) and k != cell]
            assert holders == ([] if neighbour < 0 else [neighbour])
