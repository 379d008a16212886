"""What becomes of inferred temperatures: variables of the posterior, judged like all others."""

from __future__ import annotations

import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.diagnostics import (
    STATISTICS,
    convergence,
    open_posterior,
    save_posterior,
    to_inference_data,
    worst,
)
from tests.phantoms import ball_mesh, smooth_image

MESH = ball_mesh(spacing=30.0)
CHAINS, DRAWS = 3, 60


def posterior(**options):
    fixed, moving = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    return br.build_posterior(fixed, moving, MESH, model=br.ModelConfig(**options))


def blocks(target, count=2, seed=0):
    """Independent draws in every coordinate; the chains of T_r do not mix."""
    rng = np.random.default_rng(seed)
    shape = (CHAINS, DRAWS // count)
    for _ in range(count):
        draws = {
            name: np.exp(0.1 * rng.normal(size=shape + np.shape(value)))
            for name, value in target.estimands(target.reference()).items()
        }
        if "t_elastic" in draws:
            draws["t_elastic"] = draws["t_elastic"] + np.arange(CHAINS)[:, None]
        yield draws | {name: np.zeros(shape) for name in STATISTICS}


@pytest.fixture(scope="module")
def found():
    priors = {name: {"high": 60.0} for name in ("lam", "mu")}
    target = posterior(
        normalised=True, priors=priors, t_similarity={"median": 5.0}, t_elastic={"median": 100.0}, fixed={"mu": 1.0}
    )
    given = list(blocks(target))
    return given, to_inference_data(target, given)


def test_temperatures_are_variables_of_the_posterior(found, tmp_path):
    given, idata = found
    save_posterior(idata, tmp_path / "posterior.nc")
    for data in (idata, open_posterior(tmp_path / "posterior.nc")):
        for name in ("t_similarity", "t_elastic"):
            assert data.posterior[name].dims == ("chain", "draw")
            expected = np.concatenate([block[name] for block in given], axis=1)
            np.testing.assert_array_equal(data.posterior[name], expected)


def test_temperatures_are_judged(found):
    judged = convergence(found[1])
    assert float(judged.rhat["t_similarity"]) < 1.05
    assert float(judged.rhat["t_elastic"]) > 1.5
    assert float(judged.ess_bulk["t_similarity"]) > 60 > 10 > float(judged.ess_bulk["t_elastic"])
    assert np.isfinite(judged.ess_tail["t_similarity"])


def test_known_temperatures_are_not_there():
    target = posterior()
    idata = to_inference_data(target, list(blocks(target)))
    assert set(idata.posterior.data_vars) == {"u_boundary", "lam", "mu", "ratio"}
    assert set(convergence(idata).rhat.data_vars) == {"u_boundary", "lam", "mu"}


@pytest.mark.parametrize("wrong", [0.7, np.nan])
def test_what_stands_still_or_is_no_number_has_not_converged(wrong):
    rng = np.random.default_rng(0)
    draws = {"u_boundary": rng.normal(size=(4, 500, 2, 3)), "lam": rng.normal(size=(4, 500, 2))}
    sound = worst([draws])
    assert sound.rhat < 1.01
    assert min(sound.ess_bulk, sound.ess_tail) > 1000
    # One component in all chains; a single draw that is no number.
    where = (slice(None), slice(None), 1, 2) if np.isfinite(wrong) else (0, 30, 1, 2)
    draws["u_boundary"][where] = wrong
    assert worst([draws]) == (np.inf, 0.0, 0.0)
