"""The reflected rotation: what makes it a valid trajectory, and its marginals against brute force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayesreg.inference.gaussian import reflection
from bayesreg.inference.gaussian.reflection import rotate, shift, walls

DIMENSION, NODES = 9, 3
CENTRE = np.array([[0.3, 0.0, 0.0], [0.0, 0.5, 0.0], [0.1, 0.1, 0.1]])


def ball(u):
    """Allowed inside a ball of radius one whose surface is dented: neither flat nor convex."""
    return 1.0 - jnp.linalg.norm(u, axis=-1) - 0.05 * jnp.sin(6 * u[..., 0])


@pytest.fixture(scope="module")
def made():
    rng = np.random.default_rng(0)
    rows = 0.8 * rng.normal(size=(NODES, 3, DIMENSION)) / np.sqrt(DIMENSION)
    return walls(jnp.asarray(CENTRE), jnp.asarray(rows), jnp.arange(NODES))


turn = jax.jit(lambda made, position, momentum, time: rotate(made, ball, position, momentum, time))


fly = jax.jit(lambda made, position, momentum, time: shift(made, ball, position, momentum, time))


def clearance(made, position):
    return np.asarray(ball(made.centre + made.rows @ position))


@pytest.mark.parametrize(("time", "least"), [(0.05, 0), (0.6, 4), (np.pi / 2, 20), (-0.6, 4)])
def test_energy_is_kept_and_no_wall_is_crossed(made, time, least):
    rng, reflected = np.random.default_rng(1), 0
    position = np.zeros(DIMENSION)
    for _ in range(60):
        momentum = rng.normal(size=DIMENSION)
        before = position @ position + momentum @ momentum
        unhindered = np.cos(time) * position + np.sin(time) * momentum
        position, momentum = (np.asarray(x) for x in turn(made, position, momentum, time))
        assert position @ position + momentum @ momentum == pytest.approx(before, rel=1e-12)
        assert (clearance(made, position) > -1e-9).all()
        reflected += not np.allclose(unhindered, position)
    assert reflected >= least


def test_running_backward_leads_back(made):
    rng = np.random.default_rng(2)
    for _ in range(40):
        momentum = rng.normal(size=DIMENSION)
        there = turn(made, np.zeros(DIMENSION), momentum, 1.1)
        by_momentum = turn(made, there[0], -there[1], 1.1)
        by_time = turn(made, *there, -1.1)
        np.testing.assert_allclose(by_momentum[0], 0, atol=1e-4)
        np.testing.assert_allclose(by_time[0], 0, atol=1e-4)
        np.testing.assert_allclose(by_time[1], momentum, atol=1e-4)


def test_straight_flights_keep_their_speed_and_the_walls_and_lead_back(made):
    rng, position, reflected = np.random.default_rng(6), np.zeros(DIMENSION), 0
    for _ in range(60):
        momentum = rng.normal(size=DIMENSION)
        end, last = (np.asarray(x) for x in fly(made, position, momentum, 0.7))
        assert last @ last == pytest.approx(momentum @ momentum, rel=1e-12)
        assert (clearance(made, end) > -1e-9).all()
        np.testing.assert_allclose(fly(made, end, -last, 0.7)[0], position, atol=1e-4)
        if np.allclose(end, position + 0.7 * momentum):
            np.testing.assert_allclose(last, momentum)
        else:
            reflected += 1
        position = end
    assert 10 < reflected < 60


def test_volume_is_kept(made):
    """|det ∂(position, momentum)′/∂(position, momentum)| = 1, by differences, across reflections."""
    rng = np.random.default_rng(3)

    def flow(state):
        return np.concatenate(turn(made, state[:DIMENSION], state[DIMENSION:], 0.9))

    checked = 0
    for _ in range(6):
        state = np.concatenate([np.zeros(DIMENSION), 1.5 * rng.normal(size=DIMENSION)])
        steps = 1e-6 * np.eye(2 * DIMENSION)
        jacobian = np.stack([(flow(state + step) - flow(state - step)) / 2e-6 for step in steps], axis=1)
        assert abs(np.linalg.det(jacobian)) == pytest.approx(1.0, abs=1e-4)
        straight = np.sin(0.9) * state[DIMENSION:]
        checked += not np.allclose(flow(state)[:DIMENSION], straight)
    assert checked > 2


def test_where_no_wall_is_near_it_is_a_rotation(made):
    """As where there is no skull: the clearance is infinite."""
    start, momentum = np.random.default_rng(5).normal(size=(2, DIMENSION))
    found = rotate(made, lambda u: jnp.full(u.shape[:-1], jnp.inf), start, momentum, jnp.pi / 2)
    np.testing.assert_allclose(found[0], momentum, atol=1e-12)
    np.testing.assert_allclose(found[1], -start, atol=1e-12)


def test_a_flight_that_does_not_end_is_no_place(made, monkeypatch):
    monkeypatch.setattr(reflection, "_MOST", 1)
    position, _ = rotate(made, ball, jnp.zeros(DIMENSION), 30 * jnp.ones(DIMENSION), 1.5)
    assert np.isnan(np.asarray(position)).all()


@pytest.mark.slow
def test_quarter_turns_draw_the_truncated_gaussian(made):
    """Independent momenta and quarter turns leave N(0, I) inside the walls unchanged: against rejection."""
    chains, draws = 200, 200

    @jax.jit
    def chain(key):
        def one(position, key):
            turned, _ = rotate(made, ball, position, jax.random.normal(key, position.shape), jnp.pi / 2)
            # A flight that creeps along the wall is refused, as by the samplers.
            position = jnp.where(jnp.isfinite(turned).all(), turned, position)
            return position, position

        return jax.lax.scan(one, jnp.zeros(DIMENSION), jax.random.split(key, draws))[1]

    found = np.asarray(jax.vmap(chain)(jax.random.split(jax.random.key(0), chains)))[:, 20:]
    proposals = np.random.default_rng(4).normal(size=(400_000, DIMENSION))
    places = CENTRE + np.einsum("nid,sd->sni", made.rows, proposals)
    kept = proposals[(np.asarray(ball(places)) > 0).all(axis=1)]
    assert 0.01 < len(kept) / len(proposals) < 0.9
    for power in (1, 2):
        expected, error = (kept**power).mean(axis=0), (kept**power).std(axis=0) / np.sqrt(len(kept))
        per_chain = (found**power).mean(axis=1)
        scatter = per_chain.std(axis=0, ddof=1) / np.sqrt(chains)
        assert abs((per_chain.mean(axis=0) - expected) / np.hypot(error, scatter)).max() < 4.5
