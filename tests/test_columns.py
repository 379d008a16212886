"""Chains as columns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayesreg.columns import with_chains_as_columns

RNG = np.random.default_rng(0)


@with_chains_as_columns
def weighted(shared, x, y):
    return shared[:, None] * x * y


def test_arguments_that_chains_do_not_have_are_repeated():
    shared, x, y = np.arange(3.0), np.ones((3, 1)), RNG.normal(size=(4, 3, 1))
    products = jax.vmap(lambda y: weighted(jnp.asarray(shared), jnp.asarray(x), y))(y)
    np.testing.assert_allclose(products, shared[:, None] * y)


def test_chains_of_chains_are_columns_too():
    shared, x, y = np.arange(3.0), RNG.normal(size=(5, 4, 3, 1)), RNG.normal(size=(4, 3, 1))
    products = jax.vmap(lambda x: jax.vmap(lambda x, y: weighted(jnp.asarray(shared), x, y))(x, y))(x)
    np.testing.assert_allclose(products, shared[:, None] * x * y)


@pytest.mark.parametrize(("chains", "columns"), [(4, 0), (0, 3)])
def test_nothing_stays_nothing(chains, columns):
    product = jax.vmap(lambda y: weighted(jnp.zeros(columns), jnp.ones((columns, 2)), y))(
        jnp.ones((chains, columns, 2))
    )
    assert product.shape == (chains, columns, 2)


def test_what_chains_share_cannot_differ():
    with pytest.raises(NotImplementedError, match="what weighted shares among chains"):
        jax.vmap(weighted)(np.ones((2, 3)), np.ones((2, 3, 1)), np.ones((2, 3, 1)))
