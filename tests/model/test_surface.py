"""Points on a surface without partners: against planes that move, exact inverses, and a posterior in closed form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import root

import bayesreg as br
from bayesreg.fem.location import interpolation_at
from bayesreg.model.elastic.loads import RandomLoads
from bayesreg.model.observations.level_set import distance_from_mask
from bayesreg.model.observations.observation import Summarised
from bayesreg.model.observations.surface import Surface, count_independent
from bayesreg.model.observations.surface_report import describe_far_surface, height_figure, surface_table
from bayesreg.model.state import state_of
from bayesreg.report import style
from tests.phantoms import ball_mesh, box_mesh, of_one_tissue

MESH = of_one_tissue(box_mesh(4))
TOP = MESH.points[:, 2].max()
CENTRE = np.array([5.0, -3.0, 8.0])


def points_above(height, count=200, seed=0):
    """Points over the middle of the top of the box."""
    low, high = MESH.points.min(axis=0)[:2], MESH.points.max(axis=0)[:2]
    middle = np.random.default_rng(seed).uniform(low + 0.3 * (high - low), high - 0.3 * (high - low), (count, 2))
    return np.c_[middle, np.full(count, TOP + height)]


def lifted(height):
    return np.tile([0.0, 0.0, height], (len(MESH.points), 1))


@pytest.mark.parametrize(("noise", "law"), [(br.NormalNoise(), stats.norm), (br.StudentTNoise(nu=4.0), stats.t(4.0))])
def test_the_density_is_that_of_the_distance_from_a_plane(noise, law):
    posterior = br.build_posterior(
        mesh=MESH, observations=[Surface(points_above(1.3), sd=0.4, noise=noise)], model=MODEL
    )
    for height in (0.0, 0.5, 1.3):
        values = {**posterior.reference(), "u_boundary": lifted(height)}
        expected = 200 * (law.logpdf((1.3 - height) / 0.4) - np.log(0.4))
        np.testing.assert_allclose(posterior.energies(values)["surface"], expected, rtol=1e-4)
    observation = posterior.observations["surface"]
    state = state_of(posterior.data.body, posterior.data.blocks, posterior.fill(values))
    summary = observation.summarise(posterior, state, {})
    np.testing.assert_allclose(summary["height"], 0.0, atol=1e-4)
    np.testing.assert_allclose(summary["height_at_rest"], 1.3, atol=1e-4)
    assert isinstance(observation, Summarised)
    assert observation.recorded(posterior.data.terms["surface"]).values.shape == (200,)


MODEL = br.ModelConfig(
    elasticity="uniform",
    fixed={"lam": 2.0, "mu": 1.0},
    elastic_prior=RandomLoads(body=0.1, surface=0.1),
    rigid_sd=2.0,
)


def test_the_place_of_a_point_is_where_the_displacement_brings_it_back_to():
    """The inverse of x + u(x) by a root finder of another library, for a smooth displacement of some millimetres."""
    mesh = ball_mesh(radius=40.0, spacing=13.0)

    def displacement(x):
        return np.c_[2 * np.sin(x[:, 1] / 25), 0.05 * (x[:, 0] - 5), 3 * np.cos(x[:, 0] / 30)]

    u = displacement(mesh.points)
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(40, 3))
    places = CENTRE + 33 * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def moved(x):
        nodes, weights = interpolation_at(mesh, x)
        return x + np.einsum("ka,kai->ki", weights, u[nodes])

    term = Surface(moved(places), sd=0.5).on(mesh).term
    found, _ = term._place(term._find_cells(u), term.points, jnp.asarray(u))
    # A cell is looked up on a grid of an eighth of an edge, and strains differ by some percent between cells.
    np.testing.assert_allclose(found, places, atol=0.1)
    assert np.median(np.linalg.norm(np.asarray(found) - places, axis=1)) < 0.01
    solved = root(lambda x: (moved(x[None]) - moved(places[:1]))[0], moved(places[:1])[0]).x
    np.testing.assert_allclose(solved, places[0], atol=1e-6)


def test_the_distance_from_labels_is_that_from_a_ball():
    """A mask of a ball with voxels of 1 mm gives its surface to a tenth of a voxel, and distances to a tenth."""
    grid = br.Image(np.zeros((90, 90, 90)), np.array([[1, 0, 0, -40], [0, 1, 0, -48], [0, 0, 1, -37], [0, 0, 0, 1.0]]))
    labels = grid.with_voxels((np.linalg.norm(grid.grid_points() - CENTRE, axis=-1) <= 40).astype(int))
    directions = np.random.default_rng(0).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = distance_from_mask(labels)
    for height in (-2.0, 0.0, 3.0):
        error = np.asarray(distance(jnp.asarray(CENTRE + (40 + height) * directions))) - height
        assert abs(error.mean()) < 0.05 + 0.1 * abs(height)
        assert error.std() < 0.1


def test_narrow_folds_are_bridged_and_holes_filled():
    """A ball of 4 mm sinks 0.5 mm into a fold of 4 mm of a slab with its top at 29.5 mm, and to the ground of 14 mm."""
    mask = np.zeros((60, 40, 50), np.uint8)
    mask[:, :, :30] = 1
    mask[14:18, :, 15:30] = mask[36:50, :, 15:30] = mask[25:29, 18:22, 5:9] = 0
    distance = distance_from_mask(br.Image(mask, np.eye(4)))
    over_fold, over_valley, in_hole = np.array([[15.5, 20.0, 29.5], [42.5, 20.0, 29.5], [26.5, 19.5, 6.5]])
    assert 0 < float(distance(over_fold)) < 1.0
    assert float(distance(over_valley)) > 5.0
    assert float(distance(in_hole)) < -3.0


def test_the_surface_of_the_organ_is_that_of_its_solid_tissues():
    layers = (MESH.points[MESH.cells].mean(axis=1)[:, 2] > 0.6 * TOP).astype(int)
    mesh = br.TetMesh.from_arrays(MESH.points, MESH.cells, layers, ("gm", "csf"))
    points = points_above(0.0)
    whole, solid = (Surface(points, of=of, sd=0.4).on(mesh).term for of in (("gm", "csf"), "boundary"))
    rest = jnp.zeros(mesh.points.shape)
    np.testing.assert_allclose(whole.height(rest), 0.0, atol=0.05)
    assert (np.asarray(solid.height(rest)) > 0.2 * TOP).all()


def test_the_gradient_is_that_of_differences():
    ball = ball_mesh(radius=20.0, spacing=9.0)
    rng = np.random.default_rng(1)
    points = ball.points[ball.boundary][:25] * 1.05 + rng.normal(0, 0.5, (25, 3))
    term = Surface(points, sd=0.8).on(ball).term
    u, direction = rng.normal(0, 0.1, (2, *ball.points.shape))

    def heights(u):
        return term.height(jnp.asarray(u))

    difference = (heights(u + 1e-6 * direction) - heights(u - 1e-6 * direction)) / 2e-6
    slope = jax.jvp(heights, (jnp.asarray(u),), (jnp.asarray(direction),))[1]
    np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-6)


def test_the_curvature_is_that_of_the_density():
    """Along a displacement in which the heights over a plane are linear: along z, and the same at every depth."""
    term = Surface(points_above(0.5), sd=0.4).on(MESH).term
    x, y = MESH.points[:, 0], MESH.points[:, 1]
    u = np.c_[np.zeros((len(x), 2)), 0.1 * np.cos(y / 15)]
    direction = np.c_[np.zeros((len(x), 2)), 1 + np.sin(x / 10)]

    def energy(step):
        height = term.height(jnp.asarray(u + step * direction))
        return -stats.t(4.0).logpdf(np.asarray(height) / 0.4).sum()

    expected = (energy(1e-3) - 2 * energy(0.0) + energy(-1e-3)) / 1e-6
    total = 0.0
    for part in (term.gauss_newton(jnp.asarray(u), {}), term.remainder(jnp.asarray(u), {})):
        there = np.einsum("ka,kai->ki", part.weights, direction[np.asarray(part.nodes)])
        total += np.einsum("ki,kij,kj->", there, part.matrices, there)
    np.testing.assert_allclose(total, expected, rtol=0.05)


def test_points_that_share_their_errors_count_as_few():
    """Errors that are the same within cells of 10 mm, and independent ones."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(0, 100, (1500, 2)), np.zeros(1500)]
    alone = rng.normal(size=(1500, 1))
    cells = (points[:, :2] // 10).astype(int)
    together = rng.normal(size=(10, 10, 1))[cells[:, 0], cells[:, 1]]
    assert count_independent(alone, points) > 500
    assert 50 < count_independent(together, points) < 200


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": np.zeros((0, 3))}, "shape"),
        ({"points": np.zeros((3, 3))}, "10 points or more"),
        ({"points": [[1.0, 2.0, np.inf]] * 12}, "finite"),
        ({"points": np.arange(36.0).reshape(12, 3), "sd": -1.0}, "sd must be positive"),
    ],
)
def test_wrong_surfaces_are_told(arguments, message):
    with pytest.raises(br.InputError, match=message):
        Surface(**arguments)


def test_an_unknown_tissue_is_told():
    with pytest.raises(br.InputError, match="of: the mesh has no tissue spleen; expected boundary or some of"):
        Surface(points_above(0.0), of="spleen").on(MESH)


def test_the_report_says_how_far_the_points_lie_from_the_surface():
    height = np.r_[np.linspace(-0.4, 0.4, 40), 9.0]
    summary = {
        "points": np.random.default_rng(0).normal(size=(41, 3)), "height": height, "height_at_rest": height + 5,
        "sd": np.array(0.3), "independent": np.array(12.0), "wrong": (height > 5).astype(float),
    }  # fmt: skip
    table = surface_table("surface", summary)
    assert "1 of 41 points are probably wrong" in table.caption
    assert "12 independent ones" in table.caption
    assert [row[0] for row in table.rows] == ["At rest", "At the posterior mean"]
    assert table.rows[1][3] == pytest.approx(0.4)
    assert describe_far_surface("surface", summary) == []
    (sentence,) = describe_far_surface("surface", summary | {"wrong": np.ones(41)})
    assert "41 of 41 points are probably wrong" in sentence
    figure = height_figure("surface", summary)
    drawn = style.new_figure(figure.height)
    figure.draw(drawn, style)
    assert len(drawn.axes) == 4
