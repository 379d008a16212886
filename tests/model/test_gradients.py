"""Gradients of the density through the elastic solve, against central differences."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayesreg.model.blocks import Scale
from tests.options import posterior_of
from tests.phantoms import LAM, MU, PAPER_LAM, PAPER_MU, ball_mesh, smooth_image

MESH = ball_mesh(spacing=24.0)
SETTINGS = {"t_similarity": 5.0, "t_elastic": 100.0, "interpolation": "cubic", "fixed": {}}


def by_tissue(values):
    return {name: float(value) for name, value in zip(MESH.names, values, strict=True)}


def posterior(**options):
    fixed, moving = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    return posterior_of(fixed, moving, MESH, **(SETTINGS | options))


def state(lam, mu, seed=0):
    """Position of the contract's values in (u_B, log λ, log μ)."""
    u = np.random.default_rng(seed).normal(size=(len(MESH.boundary), 3))
    return {"u_boundary": jnp.asarray(u), "lam": jnp.log(lam), "mu": jnp.log(mu)}


def directions(position, seed=1, count=3):
    """Random unit directions in each group of coordinates alone, and in all together."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        full = {name: rng.normal(size=value.shape) for name, value in position.items()}
        yield "all", full
        for group in position:
            yield group, {name: d * (name == group) for name, d in full.items()}


def central_difference(function, position, direction, step=1e-4):
    """Fourth-order: truncation and rounding both far below 1e-6."""

    def at(t):
        return float(function({name: value + t * direction[name] for name, value in position.items()}))

    return (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)


def assert_gradient(function, position):
    gradient = jax.grad(function)(position)
    for group, direction in directions(position):
        slope = sum(float((gradient[name] * direction[name]).sum()) for name in position)
        assert slope == pytest.approx(central_difference(function, position, direction), rel=1e-6), group


@pytest.mark.parametrize(("lam", "mu"), [(LAM, MU), (PAPER_LAM, PAPER_MU)], ids=["gentle", "paper"])
def test_gradient_in_u_and_log_parameters(lam, mu):
    post = posterior()

    def density(p):
        values = {"u_boundary": p["u_boundary"], "lam": jnp.exp(p["lam"]), "mu": jnp.exp(p["mu"])}
        return post.logdensity_constrained(values)

    assert_gradient(density, state(lam, mu))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"rigid_sd": 0.5, "fixed": {"mu": {"gm": 1.0}}},
        {"priors": {"lam": {"alpha": 2.0, "beta": 3.0, "low": 0.5, "high": 40.0}, "mu": {"high": 9.0}}},
    ],
    ids=["flat", "rigid prior and a fixed parameter", "bounded priors"],
)
def test_gradient_of_the_unconstrained_density(options):
    post = posterior(**options)
    lam, mu = np.array([2.0, 5.0, 30.0]), np.array([1e-2, 1.0, 1.5])
    position = post.unconstrain({**state(lam, mu), "lam": lam, "mu": mu})
    assert_gradient(post.logdensity, position)


def test_each_parameter_alone_at_the_papers_contrast():
    """The softest tissue's share must not drown in the stiffest's."""
    post = posterior()
    position = state(PAPER_LAM, PAPER_MU)

    def density(p):
        values = {"u_boundary": p["u_boundary"], "lam": jnp.exp(p["lam"]), "mu": jnp.exp(p["mu"])}
        return post.logdensity_constrained(values)

    gradient = jax.grad(density)(position)
    for name in ("lam", "mu"):
        for i in range(3):
            direction = {key: np.zeros(value.shape) for key, value in position.items()}
            direction[name][i] = 1.0
            expected = central_difference(density, position, direction, step=1e-2)
            # The soft tissue's share is 1e-9 of the density: the differences hold five digits of it.
            assert float(gradient[name][i]) == pytest.approx(expected, rel=1e-6, abs=1e-10), (name, i)
            assert abs(expected) > 1e-6


def test_jacobian_of_the_unconstrained_density():
    """logdensity = logdensity_constrained + log |d values / d position|, the determinant by automatic derivatives."""
    post = posterior(priors={"lam": {"alpha": 2.0, "beta": 3.0, "low": 0.5, "high": 40.0}})
    values = {**state(LAM, MU), "lam": LAM, "mu": MU}
    position = post.unconstrain(values)
    constrained = post.constrain(position)
    for name, value in values.items():
        np.testing.assert_allclose(constrained[name], value, rtol=1e-12)
    log_determinant = 0.0
    for name in ("lam", "mu"):
        jacobian = jax.jacobian(lambda z, name=name: post.constrain({**position, name: z})[name])(position[name])
        log_determinant += np.linalg.slogdet(jacobian)[1]
    expected = float(post.logdensity_constrained(values)) + log_determinant
    assert float(post.logdensity(position)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("similarity", ["ssd", "student_t"])
def test_curvature_in_the_displacements_is_the_hessian(similarity):
    """With its remainder, against differences of the gradient; the images differ, so that it is more than rounding."""
    post = posterior(similarity=similarity, rigid_sd=0.5, fixed={"lam": by_tissue(LAM), "mu": by_tissue(MU)})
    u = state(LAM, MU)["u_boundary"]
    curvature = post.target.mode_search.curvature(post.data, {"u_boundary": u})
    slope = jax.jit(jax.grad(lambda u: -post.logdensity({"u_boundary": u})))
    for direction in np.random.default_rng(1).normal(size=(3, *u.shape)):
        expected = (slope(u + 1e-4 * direction) - slope(u - 1e-4 * direction)) / 2e-4
        product, rest = (matrix @ direction.ravel() for matrix in (curvature.gauss_newton, curvature.remainder))
        np.testing.assert_allclose(product + rest, np.ravel(expected), atol=1e-4 * float(abs(expected).max()))
        assert abs(rest).max() > 0.01 * abs(product).max()


def test_curvature_follows_lam_and_mu():
    """The response of the free nodes is kept while these stay, and no longer: there and back, and at two places."""
    post = posterior()
    u = state(LAM, MU)["u_boundary"]
    data = post.data._replace(blocks={**post.data.blocks, "t_similarity": Scale(jnp.asarray(1e12))})
    soft, stiff, again = (
        post.target.mode_search.curvature(data, {"u_boundary": u, "lam": factor * LAM, "mu": factor * MU}).gauss_newton
        for factor in (1.0, 2.0, 1.0)
    )
    np.testing.assert_allclose(stiff, 2 * soft, atol=1e-6 * abs(soft).max())
    np.testing.assert_array_equal(again, soft)
