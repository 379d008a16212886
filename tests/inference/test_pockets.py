"""A node that the search for the mode left in a pocket of its density is put where it is far more probable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import bayesreg as br
from bayesreg.inference.gaussian import mode_search, pockets
from bayesreg.inference.gaussian.mode_search import find_mode
from bayesreg.inference.gaussian.pockets import leave_pockets
from bayesreg.inference.layout import unravel
from tests.inference.gaussians import DIMENSION, NODES, GaussianTarget
from tests.model.test_neighbourhood import MESH, posterior, state
from tests.phantoms import smooth_image

AWAY = 9.0


class Pocket(GaussianTarget):
    """N(0, covariance) and, with the second node so far away along −x, the same, lower by `depth`.

    A node is in equilibrium where N(0, covariance) has its conditional mean.
    """

    def __init__(self, depth: float, wall: float = 50.0):
        super().__init__(wall)
        self.depth = depth

    @property
    def single_nodes(self):
        return Alone(self)

    def height(self, data, u):
        away = jnp.stack([u.ravel(), u.ravel().at[3].add(AWAY)])
        heights = -0.5 * jnp.einsum("ci,ij,cj->c", away, data.precision, away) - jnp.array([0.0, self.depth])
        return jax.nn.logsumexp(heights)


class Alone:
    """The true density of a node."""

    def __init__(self, target):
        self.target = target

    def log_density(self, data, estimands, which):
        u = estimands["u_boundary"]
        return lambda place: self.target.evaluate_estimands(data, {"u_boundary": u.at[which].set(place)}).logdensity

    def equilibrium(self, data, estimands, which):
        u, precision = estimands["u_boundary"], data.precision.reshape(NODES, 3, NODES, 3)
        force = jnp.einsum("ibj,bj->i", precision[which], u)
        return u[which] - jnp.linalg.solve(precision[which, :, which], force)


def start(second_x: float = -AWAY) -> np.ndarray:
    return second_x * np.eye(DIMENSION)[3]


@pytest.mark.parametrize("at_a_time", [pockets.AT_A_TIME, 1])
def test_the_search_leaves_a_pocket(monkeypatch, at_a_time):
    monkeypatch.setattr(pockets, "AT_A_TIME", at_a_time)
    target, told = Pocket(depth=8.0), []
    np.testing.assert_allclose(find_mode(target, start(), told.append), 0, atol=1e-2)
    assert any("more probable: nodes 1" in line for line in told)
    monkeypatch.setattr(mode_search, "RESCUES", 0)
    assert find_mode(target, start())[3] == pytest.approx(-AWAY, abs=0.1)


@pytest.mark.parametrize("target", [Pocket(depth=-8.0), Pocket(depth=8.0, wall=-3.0)], ids=["higher", "wall"])
def test_the_search_stays(target):
    """Where the density is higher than where the node is in equilibrium, or where only a wall keeps it from there."""
    told = []
    assert find_mode(target, start() - 8.0 * np.eye(DIMENSION)[0], told.append)[3] == pytest.approx(-AWAY, abs=2.0)
    assert not any("more probable" in line for line in told)


def test_a_gain_that_the_density_itself_does_not_confirm_moves_nothing():
    class Misled:
        def log_density(self, data, estimands, which):
            u = estimands["u_boundary"]
            return lambda place: 100 * jnp.abs(place - u[which]).sum()

        def equilibrium(self, data, estimands, which):
            return estimands["u_boundary"][which] + 5.0

    class Wrong(Pocket):
        single_nodes = Misled()

    flat, nodes = leave_pockets(Wrong(depth=8.0), start(0.0))
    assert not len(nodes)
    np.testing.assert_array_equal(flat, start(0.0))


def test_without_sampled_nodes_or_neighbourhoods_nothing_is_looked_at():
    held = {int(node): (0.0, 0.0, 0.0) for node in MESH.boundary}
    model = br.ModelConfig(t_similarity=1.0, sampled=[], held=held, priors={"lam": {"high": 10}, "mu": {"high": 10}})
    post = br.build_posterior(smooth_image(MESH.points), smooth_image(MESH.points, seed=2), MESH, model=model)
    flat = np.asarray(ravel_pytree(post.unconstrain(post.reference()))[0])
    assert not len(leave_pockets(post, flat)[1])

    class Unknown(Pocket):
        single_nodes = None

    assert not len(leave_pockets(Unknown(depth=8.0), start())[1])


@pytest.mark.parametrize("options", [{}, {"sampled": "all"}, {"quadrature": "voxels"}])
def test_a_node_astray_between_two_equal_images_comes_back(options):
    """And no other node moves; rows of "u_boundary" are not those of prescribed nodes."""
    image, row = smooth_image(MESH.points), 11
    model = br.ModelConfig(
        t_similarity=1.0,
        t_elastic=10.0,
        interpolation="cubic",
        held={int(MESH.boundary[0]): (0, 0, 0)},
        **options,
    )
    post = br.build_posterior(image, image, MESH, model=model)
    nowhere = jnp.zeros((len(post.sampled), 3))
    astray = post.unconstrain(post.reference() | {"u_boundary": nowhere.at[row].set(jnp.array([-6.0, 5.0, 4.0]))})
    found, nodes = leave_pockets(post, np.asarray(ravel_pytree(astray)[0]))
    back = unravel(post)(found)
    assert nodes.tolist() == [row]
    assert float(post.logdensity(back)) > float(post.logdensity(astray)) + pockets.GAIN
    assert np.linalg.norm(back["u_boundary"][row]) < 3.0
    np.testing.assert_array_equal(back["u_boundary"].at[row].set(0.0), nowhere)


def test_at_rest_no_elastic_force_acts_on_a_node():
    """By differences of the strain energy, at the λ, μ that the rest follows by."""
    post = posterior()
    values, row = state(post), 11
    data = post.condition(post.estimands(values), np.array([3, row]))
    rest = np.asarray(post.single_nodes.equilibrium(data, post.estimands(values), jnp.asarray(1)))

    def energy(place):
        u = values["u_boundary"].at[row].set(jnp.asarray(place))
        return float(post.evaluate(values | {"u_boundary": u}).strain_energy)

    assert np.linalg.norm(rest - np.asarray(values["u_boundary"][row])) > 0.1
    for axis in np.eye(3):
        ahead, here, behind = (energy(rest + way * axis) for way in (1.0, 0.0, -1.0))
        assert abs(ahead - behind) < 1e-6 * (ahead + behind - 2 * here)
