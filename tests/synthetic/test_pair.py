"""Synthetic pairs: the deformation, the image that it makes, and the pair's own promises."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from bayesreg.distance import signed_distance
from bayesreg.fem.elasticity import stiffness
from bayesreg.fem.equilibrium import solve_interior
from bayesreg.fem.location import transfer
from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model.warp import volume_ratio
from bayesreg.synthetic.deformation import centre_of_gravity, push_patch, surface_patch
from bayesreg.synthetic.inversion import deformed_image, residuals
from bayesreg.synthetic.pair import make_pair
from bayesreg.types import InputError
from tests.phantoms import PAPER_LAM, PAPER_MU, ball_mesh, refined

CENTRE = np.array([5.0, -3.0, 8.0])
SKULL_RADIUS = 42.5
PATCH = {"displacement": 7.0, "patch_nodes": 8, "direction": (0.3, 0.4, 0.9)}
WAVES = np.array([[0.11, 0.03, -0.05], [-0.04, 0.12, 0.06], [0.05, -0.06, 0.10]])


class Head(NamedTuple):
    fixed: Image
    tissue: Image
    skull: Image
    mesh: TetMesh


def analytic(points: np.ndarray) -> np.ndarray:
    return 0.5 + np.sin(points @ WAVES.T).sum(axis=-1) / 6


def head(voxel: float, spacing: float = 18.0) -> Head:
    """A ball of brain with radius 40 in a cavity of radius 42.5; labels reach 1 mm beyond the mesh."""
    size = int(np.ceil(100 / voxel))
    affine = np.diag([voxel, -voxel, voxel, 1.0])
    affine[:3, 3] = CENTRE - np.diag(affine)[:3] * (size - 1) / 2
    empty = Image(np.zeros((size, size, size)), affine)
    distance = np.linalg.norm(empty.grid_points() - CENTRE, axis=-1)
    tissue = np.select([distance < 15, distance < 30, distance < 41], [1, 3, 2], 0).astype(np.int8)
    return Head(
        empty.with_voxels(analytic(empty.grid_points())),
        empty.with_voxels(tissue),
        empty.with_voxels((distance > SKULL_RADIUS).astype(np.uint8)),
        ball_mesh(spacing=spacing),
    )


def pair_of(phantom: Head, **changed):
    options = {"lam": PAPER_LAM, "mu": PAPER_MU, **PATCH, "smoothing_mm": 0.0, "noise_sd": 0.0, **changed}
    return make_pair(*phantom, **options)


@pytest.fixture(scope="module")
def small() -> Head:
    return head(voxel=2.5)


@pytest.fixture(scope="module")
def clean(small):
    return pair_of(small)


@pytest.fixture(scope="module")
def inside() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random cells, barycentric coordinates in them, and their positions at rest."""
    rng, mesh = np.random.default_rng(5), ball_mesh()
    cell, barycentric = rng.integers(len(mesh.cells), size=4000), rng.dirichlet(np.ones(4), 4000)
    return cell, barycentric, np.einsum("ka,kai->ki", barycentric, mesh.points[mesh.cells[cell]])


def mismatch(pair, inside, method) -> np.ndarray:
    """m(x + u(x)) less the analytic f(x) at random points inside the mesh."""
    cell, barycentric, rest = inside
    moved = rest + np.einsum("ka,kai->ki", barycentric, pair.u[pair.mesh.cells[cell]])
    return np.asarray(pair.moving.interpolate(moved, method)) - analytic(rest)


def test_the_patch_is_connected_and_moves_towards_the_centre(small, clean):
    mesh, patch = small.mesh, clean.deformation.patch
    assert len(set(patch)) == 8
    assert np.isin(patch, mesh.boundary).all()
    towards = centre_of_gravity(mesh) - mesh.points[patch]
    expected = 7 * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(clean.u[patch], expected, atol=1e-12)
    edges = np.zeros((len(mesh.points),) * 2, bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        edges[mesh.boundary_faces[:, a], mesh.boundary_faces[:, b]] = True
    assert connected_components(edges[np.ix_(patch, patch)])[0] == 1
    bearing = (mesh.points[mesh.boundary] - centre_of_gravity(mesh)) @ np.array(PATCH["direction"])
    assert bearing[np.searchsorted(mesh.boundary, patch)].min() > np.median(bearing)


def test_no_tetrahedron_inverts_and_no_node_enters_the_skull(small, clean):
    np.testing.assert_allclose(clean.deformation.volume_ratio, volume_ratio(small.mesh, clean.u), atol=1e-10)
    assert clean.deformation.volume_ratio.min() > 0
    place = (small.mesh.points + clean.u)[small.mesh.boundary]
    distance = np.asarray(signed_distance(small.skull).interpolate(place))
    assert distance.min() > 0.09
    # Without the skull the far side would follow the patch out of the cavity.
    loose = push_patch(
        small.mesh, small.skull.with_voxels(np.zeros(small.skull.shape)), lam=PAPER_LAM, mu=PAPER_MU, **PATCH
    )
    escaped = (small.mesh.points + loose.u)[small.mesh.boundary]
    assert np.asarray(signed_distance(small.skull).interpolate(escaped)).min() < -2
    assert len(loose.contact) == 0


def test_the_least_energy_is_an_equilibrium_with_contact_forces(small, clean):
    mesh, truth = small.mesh, clean.deformation
    assert truth.minimum.converged
    assert 5 < len(truth.contact) < len(mesh.boundary)
    force = (stiffness(mesh, PAPER_LAM, PAPER_MU) @ clean.u.ravel()).reshape(-1, 3)
    free = np.setdiff1d(np.arange(len(mesh.points)), np.concatenate([truth.patch, truth.contact]))
    largest = np.abs(force).max()
    assert np.abs(force[free]).max() < 1e-6 * largest
    # The skull only pushes: inwards, along its own normal (a ball's, up to the voxels).
    pressed = force[truth.contact]
    inwards = CENTRE - (mesh.points + clean.u)[truth.contact]
    cosine = (pressed * inwards).sum(axis=1) / np.linalg.norm(pressed, axis=1) / np.linalg.norm(inwards, axis=1)
    assert cosine.min() > 0.95
    equilibrium = solve_interior(mesh, PAPER_LAM, PAPER_MU, clean.u[mesh.boundary])
    np.testing.assert_allclose(equilibrium.u, clean.u, atol=1e-5)


def test_moving_at_displaced_points_is_fixed_at_rest(clean, inside):
    # Linear interpolation over 2.5 mm of waves of 50 mm, up to the surface itself.
    assert np.abs(mismatch(clean, inside, "linear")).max() < 0.015
    assert mismatch(clean, inside, "linear").std() < 3e-3
    # A cubic B-spline is better, but reaches farther across the surface, into what did not move.
    deep = np.linalg.norm(inside[2] - CENTRE, axis=1) < 34
    assert deep.sum() > 1000
    assert np.abs(mismatch(clean, inside, "cubic")[deep]).max() < 6e-3
    assert clean.residual_sd == clean.interpolation_sd < 0.006
    # The deformation matters: without it the images disagree by far more.
    assert np.std(np.asarray(clean.moving.interpolate(inside[2])) - analytic(inside[2])) > 0.05


def test_the_error_falls_with_the_voxel_size(clean, inside):
    error = []
    for voxel in (5.0, 2.5, 1.25):
        phantom = head(voxel)
        moving = deformed_image(phantom.fixed, phantom.tissue, phantom.skull, phantom.mesh, clean.u, 0.0)
        error.append(np.abs(mismatch(clean._replace(moving=moving), inside, "linear")).mean())
    assert error[1] < error[0] / 3
    assert error[2] < error[1] / 3


def test_no_displacement_leaves_the_image_alone(small):
    moving = deformed_image(*small[:3], small.mesh, np.zeros_like(small.mesh.points), 9.0)
    np.testing.assert_allclose(moving.voxels, small.fixed.voxels, atol=1e-9)


def test_outside_the_mesh_csf_fills_what_the_brain_leaves_and_the_skull_stays(small, clean):
    csf = np.median(small.fixed.voxels[small.tissue.voxels == 1])
    moving, points = np.asarray(clean.moving.voxels), small.fixed.grid_points()
    patch = clean.deformation.patch[0]
    vacated = np.linalg.norm(points - (small.mesh.points + 0.2 * clean.u)[patch], axis=-1) < 1.8
    assert vacated.any()
    np.testing.assert_allclose(moving[vacated], csf)
    skull = np.linalg.norm(points - CENTRE, axis=-1) > SKULL_RADIUS + 5
    np.testing.assert_array_equal(moving[skull], small.fixed.voxels[skull])


def test_tissue_beyond_the_mesh_rides_on_its_surface(small, clean):
    patch = clean.deformation.patch[0]
    outwards = small.mesh.points[patch] - centre_of_gravity(small.mesh)
    rest = small.mesh.points[patch] + 0.5 * outwards / np.linalg.norm(outwards)
    on_surface = np.asarray(clean.moving.interpolate(rest + clean.u[patch]))
    assert on_surface == pytest.approx(float(analytic(rest)), abs=0.03)


def test_noise_is_independent_and_repeats_with_its_seed(small, clean):
    first, again, reseeded = (pair_of(small, noise_sd=0.01, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.u, clean.u)
    for name in ("fixed", "moving"):
        noise, more = (np.ravel(getattr(p, name).voxels - getattr(clean, name).voxels) for p in (first, reseeded))
        np.testing.assert_array_equal(getattr(first, name).voxels, getattr(again, name).voxels)
        assert noise.std() == pytest.approx(0.01, rel=0.02)
        assert abs(np.corrcoef(noise, more)[0, 1]) < 0.02
    of_fixed, of_moving = (
        np.ravel(getattr(first, name).voxels - getattr(clean, name).voxels) for name in ("fixed", "moving")
    )
    assert abs(np.corrcoef(of_fixed, of_moving)[0, 1]) < 0.02
    assert first.interpolation_sd == clean.residual_sd < first.residual_sd


def test_smoothing_lowers_what_interpolation_leaves(small, clean):
    rough = small.fixed.voxels + 0.2 * np.random.default_rng(0).normal(size=small.fixed.shape)
    rough_phantom = small._replace(fixed=small.fixed.with_voxels(rough))
    none, some = (pair_of(rough_phantom, smoothing_mm=sd).interpolation_sd for sd in (0.0, 2.5))
    assert some < none / 3


def test_a_finer_mesh_makes_the_truth_of_a_coarser_one(clean):
    fine = refined(clean.mesh)
    u = transfer(clean.u, clean.mesh, fine.points)
    np.testing.assert_allclose(transfer(u, fine, clean.mesh.points), clean.u, atol=1e-9)
    assert residuals(clean.fixed, clean.moving, fine, u).std() < 0.003


def test_surface_patches_grow_with_their_number():
    mesh = ball_mesh()
    small, large = (surface_patch(mesh, count, np.array([0.0, 1.0, 0.0])) for count in (5, 12))
    np.testing.assert_array_equal(small, large[:5])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"displacement": 25.0}, r"inverts \d+ of \d+ tetrahedra .*direction"),
        ({"margin": 0.0}, "margin must be positive"),
        ({"displacement": -4.0}, r"8 of the 8 patch nodes .*skull"),
        ({"patch_nodes": 2}, "at least 3 nodes"),
        ({"patch_nodes": 500}, r"surface \(\d+\), got 500"),
        ({"direction": (0.0, 0.0, 0.0)}, "direction of the patch must not be zero"),
        ({"mu": np.array([0.0, 1.0, 1.0])}, "mu > 0"),
        ({"noise_sd": -0.1}, "noise_sd must not be negative"),
    ],
)
def test_bad_arguments(small, changed, message):
    with pytest.raises(InputError, match=message):
        pair_of(small, **changed)


def test_another_direction_is_tried_where_none_is_asked_for(small, monkeypatch):
    options = {"lam": PAPER_LAM, "mu": PAPER_MU, "displacement": 13.0, "patch_nodes": 8}
    bad, good = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    with pytest.raises(InputError, match="inverts"):
        push_patch(small.mesh, small.skull, direction=bad, **options)
    monkeypatch.setattr("bayesreg.synthetic.deformation.DIRECTIONS", (bad, good))
    deformation = push_patch(small.mesh, small.skull, **options)
    np.testing.assert_array_equal(deformation.patch, surface_patch(small.mesh, 8, np.array(good)))


def test_bad_images(small):
    shifted = small.tissue.affine.copy()
    shifted[0, 3] += 3
    tight = small.skull.with_voxels((np.linalg.norm(small.skull.grid_points() - CENTRE, axis=-1) > 36).astype(np.uint8))
    no_tissue_free = small.tissue.with_voxels(np.maximum(small.tissue.voxels, 1))
    no_csf = small.tissue.with_voxels(np.where(small.tissue.voxels == 1, 2, small.tissue.voxels))
    unnamed = TetMesh.from_arrays(small.mesh.points, small.mesh.cells, small.mesh.tissue, ("a", "b", "c"))
    corner = Image(small.fixed.voxels, small.fixed.affine + np.outer([1, 0, 0, 0], [0, 0, 0, 60.0]))
    for changed, message in (
        ({"tissue": Image(small.tissue.voxels, shifted)}, "tissue image must lie on the grid"),
        ({"skull": tight}, r"\d+ boundary nodes lie in the skull before"),
        ({"tissue": no_csf}, "no csf voxel"),
        ({"mesh": unnamed, "tissue": no_tissue_free}, "no place without tissue voxel"),
        (dict(zip(("fixed", "tissue", "skull"), (corner,) * 3, strict=True)), "nodes of the mesh lie off the grid"),
    ):
        with pytest.raises(InputError, match=message):
            pair_of(small._replace(**changed))
