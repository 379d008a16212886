"""The example of docs/samplers.md: a kernel of BlackJAX on the log density of a posterior."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import bayesreg as br
from tests.phantoms import box_mesh


def posterior() -> br.Posterior:
    """Twelve landmarks in a box of known stiffness: u_B is Gaussian."""
    points = np.random.default_rng(0).uniform(2, 18, (12, 3))
    prior = br.Boltzmann(temperature=20.0)
    stiffness = {"lam": 1.0, "mu": 1.0}
    model = br.ModelConfig(elasticity="uniform", fixed=stiffness, elastic_prior=prior, rigid_sd=2.0)
    return br.build_posterior(box_mesh(2), [br.Landmarks(points, points + 0.5, sd=0.5, noise=br.NormalNoise())], model)


@pytest.mark.slow
def test_the_example_of_the_docs_draws_from_the_posterior():
    text = (Path(__file__).parents[1] / "docs" / "samplers.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    target = posterior()
    names = {"posterior": target}
    exec(example, names)
    draws = np.asarray(names["draws"]["u_boundary"])
    assert draws.shape == (4, 20_000, len(target.sampled), 3)
    draws = draws[:, 2000:].reshape(4, 18_000, -1)

    # The log density is quadratic, so that differences of its gradient are its second derivatives.
    rest, to_state = ravel_pytree(target.unconstrain(target.reference()))
    gradient = jax.jit(jax.grad(lambda x: target.logdensity(to_state(x))))
    at_rest = np.asarray(gradient(rest))
    precision = np.stack([at_rest - np.asarray(gradient(rest + unit)) for unit in np.eye(rest.size)])
    mean = np.linalg.solve(precision, at_rest)
    sd = np.sqrt(np.diag(np.linalg.inv(precision)))
    assert (abs(draws.mean(axis=(0, 1)) - mean) / sd).max() < 0.3
    np.testing.assert_allclose(draws.std(axis=(0, 1)) / sd, 1.0, atol=0.12)
