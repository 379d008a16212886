"""The approximate density of single nodes against the density itself."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.model import neighbourhood
from tests.phantoms import ball_mesh, flat_skull, smooth_image

MESH = ball_mesh(spacing=24.0)


@cache
def posterior(similarity: str = "ssd", quadrature: str = "gauss4", sampled: str = "boundary") -> br.Posterior:
    """One node is held, so that rows of "u_boundary" are not those of prescribed nodes."""
    fixed, moving = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    top = MESH.points[:, 0].max()
    skull = flat_skull(MESH.points, axis=0, wall=top + 1.5, voxel=2.0)
    model = br.ModelConfig(
        similarity=similarity,
        t_similarity={"median": 5.0, "log_sd": 0.5},
        t_elastic=10.0,
        interpolation="cubic",
        quadrature=quadrature,
        sampled=sampled,
        independent_points=100.0,
        rigid_sd=0.5,
        held={int(MESH.boundary[0]): (0.5, -0.3, 0.2)},
    )
    return br.build_posterior(fixed, moving, MESH, model=model, skull=skull)


def state(post: br.Posterior) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    u = jnp.asarray(0.4 * rng.normal(size=(len(post.sampled), 3)))
    warm = {"u_boundary": u, "t_similarity": jnp.asarray(9.0)}
    return post.reference() | warm | {"lam": jnp.array([2.0, 5.0, 8.0]), "mu": jnp.array([0.5, 1.0, 1.5])}


def loose(post: br.Posterior) -> np.ndarray:
    """Rows of "u_boundary"; the last is that of the node next to the skull."""
    return np.array([3, 17, int(MESH.points[post.sampled, 0].argmax())])


@partial(jax.jit, static_argnums=0)
def local(post: br.Posterior, data: Any, estimands: Any, u: Any) -> Any:
    """Log densities (k, c) of displacements (k, c, 3) of the nodes."""
    logs = [post.single_nodes.log_density(data, estimands, jnp.asarray(which)) for which in range(len(u))]
    return jnp.stack([jax.lax.map(log, places) for log, places in zip(logs, u, strict=True)])


def changes(post: br.Posterior, moved_from: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Of the density where one of the nodes moves, approximately and exactly; λ, μ away from where the rest follows."""
    rows, values, step = loose(post), state(post), 3.0 * np.random.default_rng(1).normal(size=(3, 12, 3))
    away = values | {name: values[name] * np.exp(moved_from) for name in ("lam", "mu")}
    data = post.condition(post.estimands(values), rows)
    u = values["u_boundary"][rows][:, None] + jnp.asarray(step).at[:, 0].set(0.0)
    found = np.asarray(local(post, data, post.estimands(away), u))
    at = values["u_boundary"]
    exact = np.array(
        [
            [post.evaluate(away | {"u_boundary": at.at[row].set(place)}).logdensity for place in places]
            for row, places in zip(rows, u, strict=True)
        ]
    )
    return found - found[:, :1], exact - exact[:, :1]


@pytest.mark.parametrize("options", [("ssd",), ("student_t",), ("lncc",), ("ssd", "voxels"), ("ssd", "gauss4", "all")])
def test_it_is_the_density_where_the_neighbourhood_is_everything(options, monkeypatch):
    monkeypatch.setattr(neighbourhood, "CELLS", len(MESH.cells))
    found, exact = changes(posterior(*options))
    inside = np.isfinite(exact)
    assert 0 < (~inside).sum() < inside.sum()
    np.testing.assert_array_equal(np.isfinite(found), inside)
    assert abs(exact[inside]).max() > 5
    np.testing.assert_allclose(found[inside], exact[inside], atol=2e-3)


def test_it_is_near_the_density_where_part_of_it_is_seen(monkeypatch):
    monkeypatch.setattr(neighbourhood, "CELLS", 60)
    found, exact = changes(posterior(), moved_from=0.1)
    inside = np.isfinite(exact)
    assert 0 < abs(found - exact)[inside].max() < 0.2 * abs(exact[inside]).max()


def test_the_sum_over_the_nodes_is_one_function_of_them():
    """Where one of them is changes nothing in what is said of another."""
    post = posterior()
    rows, values = loose(post), state(post)
    data = post.condition(post.estimands(values), rows)
    u = values["u_boundary"][rows][:, None] + jnp.linspace(0, 1, 12)[None, :, None]
    elsewhere = values | {"u_boundary": values["u_boundary"].at[rows[0]].add(3.0)}
    here, there = (local(post, data, post.estimands(v), u) for v in (values, elsewhere))
    np.testing.assert_array_equal(here[1:], there[1:])


def test_without_nodes_there_are_no_neighbourhoods():
    post = posterior()
    assert post.condition(post.estimands(state(post))).neighbourhoods is None
