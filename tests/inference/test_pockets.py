"""A node that the search for the mode left in a pocket of its density is put where it is far more probable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import bayesreg as br
from bayesreg.inference import mode
from bayesreg.inference.laplace import unravel
from bayesreg.inference.mode import find_mode
from bayesreg.inference.pockets import out_of_pockets
from tests.inference.gaussians import DIMENSION, NODES, GaussianTarget
from tests.model.test_neighbourhood import MESH, posterior, state
from tests.phantoms import smooth_image

AWAY = 9.0


class Pocket(GaussianTarget):
    """N(0, covariance) and, with the first node so far away along y, the same, lower by `depth`.

    No force acts on a node where N(0, covariance) has its conditional mean.
    """

    def __init__(self, depth: float):
        super().__init__(wall=50.0)
        self.depth = depth

    def logdensity_of(self, data, position):
        flat = position["u_boundary"].ravel()
        away = jnp.stack([flat, flat.at[1].add(-AWAY)])
        heights = -0.5 * jnp.einsum("ci,ij,cj->c", away, data.precision, away) - jnp.array([0.0, self.depth])
        return jax.nn.logsumexp(heights)

    def local_logdensity(self, data, estimands, which):
        u = estimands["u_boundary"]
        return lambda place: self.logdensity_of(data, {"u_boundary": u.at[which].set(place)})

    def place_of_rest(self, data, estimands, which):
        u, precision = estimands["u_boundary"], data.precision.reshape(NODES, 3, NODES, 3)
        force = jnp.einsum("ibj,bj->i", precision[which], u)
        return u[which] - jnp.linalg.solve(precision[which, :, which], force)


def start(first_y: float) -> np.ndarray:
    return np.zeros(DIMENSION) + first_y * np.eye(DIMENSION)[1]


def test_the_search_leaves_a_pocket(monkeypatch):
    target, told = Pocket(depth=6.0), []
    np.testing.assert_allclose(find_mode(target, start(AWAY), told.append), 0, atol=1e-2)
    assert any("put elsewhere: nodes 0" in line for line in told)
    monkeypatch.setattr(mode, "RESCUES", 0)
    assert find_mode(target, start(AWAY))[1] == pytest.approx(AWAY, abs=0.1)


def test_the_search_stays_where_the_density_is_highest():
    """Also if no force acts on the node somewhere else."""
    told = []
    found = find_mode(Pocket(depth=-6.0), start(AWAY), told.append)
    assert found[1] == pytest.approx(AWAY, abs=0.1)
    assert not any("put elsewhere" in line for line in told)


def test_a_gain_that_the_density_itself_does_not_confirm_moves_nothing():
    class Wrong(Pocket):
        def local_logdensity(self, data, estimands, which):
            u = estimands["u_boundary"]
            return lambda place: 100 * jnp.abs(place - u[which]).sum()

        def place_of_rest(self, data, estimands, which):
            return estimands["u_boundary"][which] + 5.0

    flat, nodes = out_of_pockets(Wrong(depth=6.0), start(0.0))
    assert not len(nodes)
    np.testing.assert_array_equal(flat, start(0.0))


@pytest.mark.parametrize("sampled", ["boundary", "all"])
def test_a_node_astray_between_two_equal_images_comes_back(sampled):
    """And no other node moves; rows of "u_boundary" are not those of prescribed nodes."""
    image, row = smooth_image(MESH.points), 11
    model = br.ModelConfig(
        t_similarity=1.0,
        t_elastic=10.0,
        interpolation="cubic",
        sampled=sampled,
        held={int(MESH.boundary[0]): (0, 0, 0)},
    )
    post = br.build_posterior(image, image, MESH, model=model)
    nowhere = jnp.zeros((len(post.sampled), 3))
    astray = post.unconstrain(post.reference() | {"u_boundary": nowhere.at[row].set(jnp.array([-6.0, 5.0, 4.0]))})
    found, nodes = out_of_pockets(post, np.asarray(ravel_pytree(astray)[0]))
    back = unravel(post)(found)
    assert nodes.tolist() == [row]
    assert float(post.logdensity(back)) > float(post.logdensity(astray)) + 1
    assert np.linalg.norm(back["u_boundary"][row]) < 3.0
    np.testing.assert_array_equal(back["u_boundary"].at[row].set(0.0), nowhere)


def test_at_rest_no_elastic_force_acts_on_a_node():
    """By differences of the strain energy, at the λ, μ that the rest follows by."""
    post = posterior()
    values, row = state(post), 11
    data = post.conditioned(post.estimands(values), np.array([3, row]))
    rest = np.asarray(post.place_of_rest(data, post.estimands(values), jnp.asarray(1)))

    def energy(place):
        u = values["u_boundary"].at[row].set(jnp.asarray(place))
        return float(post.evaluate(values | {"u_boundary": u}).strain_energy)

    assert np.linalg.norm(rest - np.asarray(values["u_boundary"][row])) > 0.1
    for axis in np.eye(3):
        ahead, here, behind = (energy(rest + way * axis) for way in (1.0, 0.0, -1.0))
        assert abs(ahead - behind) < 1e-6 * (ahead + behind - 2 * here)
