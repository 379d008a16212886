"""What becomes of inferred temperatures: variables of the posterior, judged like all others."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import xarray as xr

from bayesreg.inference.draws import diagnostics, inference_data
from bayesreg.inference.draws.diagnostics import convergence, figures, labelled, worst
from bayesreg.inference.draws.inference_data import (
    STATISTICS,
    open_posterior,
    save_posterior,
    to_blocks,
    to_inference_data,
)
from bayesreg.io.checkpoints import StoredBlocks
from bayesreg.io.run_folder import RunFolder
from tests.options import posterior_of
from tests.phantoms import ball_mesh, smooth_image

MESH = ball_mesh(spacing=30.0)
CHAINS, DRAWS = 3, 60


def posterior(**options):
    fixed, moving = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    return posterior_of(fixed, moving, MESH, **options)


def blocks(target, count=2, seed=0):
    """Independent draws in every coordinate; the chains of T_r do not mix."""
    rng = np.random.default_rng(seed)
    shape = (CHAINS, DRAWS // count)
    for _ in range(count):
        draws = {
            name: np.exp(0.1 * rng.normal(size=shape + np.shape(value)))
            for name, value in target.coordinates.reference().items()
        }
        if "t_elastic" in draws:
            draws["t_elastic"] = draws["t_elastic"] + np.arange(CHAINS)[:, None]
        yield draws | {name: np.zeros(shape) for name in STATISTICS}


@pytest.fixture(scope="module")
def found():
    priors = {name: {"high": 60.0} for name in ("lam", "mu")}
    target = posterior(
        normalised=True, priors=priors, t_similarity={"median": 5.0}, t_elastic={"median": 100.0}, fixed={"mu": 1.0}
    ).target
    draw_blocks = list(blocks(target))
    return target, draw_blocks, to_inference_data(target, draw_blocks)


def test_temperatures_are_variables_of_the_posterior(found, tmp_path):
    target, draw_blocks, idata = found
    save_posterior(target, draw_blocks, tmp_path / "posterior.nc")
    for data in (idata, open_posterior(tmp_path / "posterior.nc")):
        for name in ("t_similarity", "t_elastic"):
            assert data.posterior[name].dims == ("chain", "draw")
            expected = np.concatenate([block[name] for block in draw_blocks], axis=1)
            np.testing.assert_array_equal(data.posterior[name], expected)


def test_temperatures_are_judged(found):
    judged = convergence(found[2])
    assert float(judged.rhat["t_similarity"]) < 1.05
    assert float(judged.rhat["t_elastic"]) > 1.5
    assert float(judged.ess_bulk["t_similarity"]) > 60 > 10 > float(judged.ess_bulk["t_elastic"])
    assert np.isfinite(judged.ess_tail["t_similarity"])


def test_known_temperatures_are_not_there():
    target = posterior().target
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


def test_figures_of_draws_in_parts_are_those_of_all_at_once(found, tmp_path, monkeypatch):
    target, draw_blocks, _ = found
    save_posterior(target, draw_blocks, tmp_path / "posterior.nc")
    idata = open_posterior(tmp_path / "posterior.nc")
    figures_at_once, extremes = convergence(idata), worst(draw_blocks)
    monkeypatch.setattr(diagnostics, "AT_ONCE", 3 * CHAINS * DRAWS)
    monkeypatch.setattr(diagnostics, "READ_AT_ONCE", 7 * CHAINS * DRAWS)
    assert len(list(diagnostics._columns(draw_blocks, None))) == -(-diagnostics._flat(draw_blocks[0]).shape[-1] // 7)
    assert worst(draw_blocks) == extremes
    for expected, figures_in_parts in zip(figures_at_once, convergence(idata), strict=True):
        assert set(figures_in_parts.data_vars) == set(expected.data_vars)
        for name in expected.data_vars:
            assert figures_in_parts[name].dims == expected[name].dims
            np.testing.assert_array_equal(figures_in_parts[name], expected[name])


def test_figures_of_blocks_are_those_of_the_file(found, tmp_path):
    """With the known modulus NaN in both; a file has displacements in single precision, which ranks hardly notice."""
    target, draw_blocks, idata = found
    labels = labelled(target, draw_blocks, figures(draw_blocks))
    save_posterior(target, draw_blocks, tmp_path / "posterior.nc")
    for tolerance, data in ((1e-12, idata), (1e-2, open_posterior(tmp_path / "posterior.nc"))):
        for of_blocks, of_data in zip(labels, convergence(data), strict=True):
            xr.testing.assert_allclose(of_blocks, of_data, rtol=tolerance)
    assert labels.rhat["mu"].isnull().all()
    assert labels.rhat["lam"].notnull().all()


def test_blocks_are_judged_by_name(found):
    """Those of a continued run have their names in another order than those read back of the finished one."""
    _, draw_blocks, _ = found
    assert worst([dict(reversed(draw_blocks[0].items())), draw_blocks[1]]) == worst(draw_blocks)


def test_blocks_of_unequal_lengths_come_back_from_the_file(found, tmp_path):
    target, draw_blocks, idata = found
    cut = [
        {name: values[:, draw_range] for name, values in draw_blocks[0].items()}
        for draw_range in (slice(0, 12), slice(12, None))
    ]
    save_posterior(target, [*cut, draw_blocks[1]], tmp_path / "posterior.nc")
    again = open_posterior(tmp_path / "posterior.nc")
    np.testing.assert_array_equal(again.posterior["draw"], idata.posterior["draw"])
    np.testing.assert_allclose(again.posterior["u_boundary"], idata.posterior["u_boundary"], rtol=1e-6)
    np.testing.assert_array_equal(again.sample_stats["lp"], idata.sample_stats["lp"])
    lengths = [25, 25, 10]
    for block, length in zip(to_blocks(target, again, 25), lengths, strict=True):
        assert {len(values[0]) for values in block.values()} == {length}
    np.testing.assert_array_equal(np.concatenate([b["lam"] for b in to_blocks(target, again, 25)], axis=1),
                                  np.concatenate([block["lam"] for block in draw_blocks], axis=1))  # fmt: skip


@pytest.mark.long
@pytest.mark.slow
def test_memory_does_not_grow_with_the_draws(tmp_path, monkeypatch):
    """Keeping, judging and writing ten times the draws, hardly more is held at once: temporaries of one estimand."""
    target = posterior().target
    monkeypatch.setattr(diagnostics, "AT_ONCE", 2**14)
    monkeypatch.setattr(diagnostics, "READ_AT_ONCE", 2**14)
    monkeypatch.setattr(inference_data, "WRITTEN_AT_ONCE", 2**14)
    # What is imported at the first call is no draw.
    _judged_and_written(target, tmp_path / "first", 2)
    peak_of_few, peak_of_many = (_judged_and_written(target, tmp_path / f"{count}", count) for count in (6, 30))
    added = 24 * sum(values.nbytes for values in next(blocks(target)).values())
    assert peak_of_many - peak_of_few < 0.2 * added


def _judged_and_written(target, folder, count):
    """The greatest number of bytes at once, in the end and on the way."""
    folder.mkdir()
    stored_blocks = StoredBlocks(RunFolder(folder), 0)
    tracemalloc.start()
    for index in range(count):
        stored_blocks.append(next(blocks(target, seed=index)))
    worst(stored_blocks)
    save_posterior(target, stored_blocks, folder / "posterior.nc")
    idata = open_posterior(folder / "posterior.nc")
    convergence(idata)
    for _ in to_blocks(target, idata, DRAWS):
        pass
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most
