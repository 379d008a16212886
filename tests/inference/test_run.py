"""Blocks, budgets and checkpoints: what is kept, and that it does not depend on how the work was cut."""

from functools import cache, partial

import jax
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.chains.beginning import checkpoint_from_arrays
from bayesreg.inference.chains.block import run_block
from bayesreg.inference.chains.checkpoint import checkpoint_to_arrays
from bayesreg.inference.chains.initialise import starting_points
from bayesreg.inference.draws.diagnostics import convergence
from bayesreg.inference.draws.inference_data import open_posterior, save_posterior
from bayesreg.inference.samplers.random_walk import rwmh
from bayesreg.inference.samplers.registry import SAMPLERS
from tests.inference.gaussians import GaussianTarget
from tests.phantoms import box_mesh, flat_skull, smooth_image

MESH = box_mesh(2)
OPTIONS = {"sampler": "rwmh", "chains": 3, "thin": 3, "seed": 5, "progress": False, "sigma_u": 0.05}


def posterior_of(seed: int, width: float = 0.0) -> br.Posterior:
    fixed, moving = smooth_image(MESH.points, seed=seed), smooth_image(MESH.points, seed=seed + 1)
    skull = flat_skull(MESH.points, axis=2, wall=MESH.points[:, 2].max() + 0.05, voxel=2.0)
    return br.build_posterior(MESH, [br.ImagePair(fixed, moving)], br.ModelConfig(skull_width=width), skull)


@cache
def posterior() -> br.Posterior:
    return posterior_of(1)


@cache
def whole():
    blocks = []
    samples = br.sample(posterior(), draws=12, block=4, on_block=lambda *arguments: blocks.append(arguments), **OPTIONS)
    return samples, blocks


def draws(samples):
    return {name: samples.idata.posterior[name].values for name in ("u_boundary", "lam", "mu")}


def test_draws_do_not_depend_on_the_blocks():
    single_block = br.sample(posterior(), draws=12, block=12, **OPTIONS)
    for name, values in draws(whole()[0]).items():
        np.testing.assert_array_equal(values, draws(single_block)[name])


@pytest.mark.parametrize("target", [GaussianTarget(wall=0.1, width=0.0), None], ids=["gaussian", "registration"])
def test_steps_passed_over_are_those_that_one_after_the_other_stay_where_they_are(monkeypatch, target):
    each = SAMPLERS["rwmh"]._replace(make=lambda *arguments: rwmh(*arguments)._replace(outside=None))
    monkeypatch.setitem(SAMPLERS, "each", each)
    # Often outside, and often not.
    sampled_target, sigma_u = (posterior(), 0.05) if target is None else (target, 0.8)

    def drawn(sampler):
        samples = br.sample(sampled_target, sampler, 3, 20, 5, thin=4, block=10, progress=False, sigma_u=sigma_u)
        values = {name: np.concatenate([block[name] for block in samples.blocks], 1) for name in samples.blocks[0]}
        return samples.tally, values | {"mean of u": samples.u_mean, "sd of u": samples.u_sd, **samples.rhat}

    (tally, passed_over), (tally_alone, expected) = drawn("rwmh"), drawn("each")
    for name in expected:
        np.testing.assert_allclose(passed_over[name], expected[name], rtol=1e-9, atol=1e-12)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9), tally, tally_alone)
    assert (tally.densities == tally.steps - tally.outside_support).all()
    assert (tally.steps == 80).all()
    assert (tally.outside_support > 8).all()
    assert (tally.densities > 8).all()
    assert (passed_over["outside_support"] == 4).any()


def test_a_resumed_run_is_the_run_that_was_not_cut_off():
    samples, blocks = whole()
    arrays = {name: value.copy() for name, value in checkpoint_to_arrays(blocks[0][2]).items()}
    checkpoint = checkpoint_from_arrays(arrays, posterior().target, "rwmh", 3)
    assert int(checkpoint.draws) == 4
    resumed_blocks = [blocks[0][1]]
    resumed = br.sample(posterior(), draws=12, block=4, resume=(checkpoint, resumed_blocks), **OPTIONS)
    assert resumed.blocks is resumed_blocks
    assert [len(block["lp"][0]) for block in resumed_blocks] == [4, 4, 4]
    for name, values in draws(samples).items():
        np.testing.assert_array_equal(values, draws(resumed)[name])
    np.testing.assert_array_equal(resumed.u_sd, samples.u_sd)
    np.testing.assert_array_equal(resumed.tally.acceptance, samples.tally.acceptance)


def test_what_is_compiled_serves_another_seed_and_another_pair_on_the_mesh():
    again = br.sample(posterior(), draws=12, block=4, **OPTIONS)
    compiled = run_block._cache_size()
    np.testing.assert_array_equal(draws(again)["u_boundary"], draws(whole()[0])["u_boundary"])
    seeded = br.sample(posterior(), draws=12, block=4, **OPTIONS | {"seed": 6})
    paired = br.sample(posterior_of(3), draws=12, block=4, **OPTIONS)
    assert run_block._cache_size() == compiled
    for samples in (seeded, paired):
        assert (draws(samples)["u_boundary"] != draws(again)["u_boundary"]).any()
    br.sample(posterior(), draws=12, block=4, **OPTIONS | {"sigma_u": 0.06})
    assert run_block._cache_size() == compiled + 1


@pytest.mark.parametrize("value", [np.array(0.05), np.float64(0.05)])
def test_a_setting_may_be_a_number_of_numpys(value):
    samples = br.sample(posterior(), draws=12, block=4, **OPTIONS | {"sigma_u": value})
    np.testing.assert_array_equal(draws(samples)["u_boundary"], draws(whole()[0])["u_boundary"])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sigma_u": np.ones(3)}, r"sampler rwmh: sigma_u = array\(\[1., 1., 1.\]\): expected a valid number"),
        ({"sigma_u": -0.1}, "sigma_u = -0.1: expected greater than 0"),
        ({"sigma": 0.1}, "there is no setting sigma; there are sigma_u, sigma_lam, sigma_mu"),
    ],
)
def test_a_setting_that_is_none_is_refused(settings, message):
    with pytest.raises(br.InputError, match=message):
        br.sample(posterior(), **OPTIONS | settings)


def test_a_checkpoint_of_another_problem_is_refused():
    arrays = checkpoint_to_arrays(whole()[1][0][2])
    with pytest.raises(ValueError, match="another problem"):
        checkpoint_from_arrays(arrays, posterior().target, "rwmh", 4)


def test_accumulated_mean_and_sd_are_those_of_the_draws():
    samples, _ = whole()
    values = draws(samples)["u_boundary"]
    flat = values.reshape(-1, *values.shape[2:])
    np.testing.assert_allclose(samples.u_mean[MESH.boundary], flat.mean(axis=0), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(samples.u_sd[MESH.boundary], flat.std(axis=0, ddof=1), rtol=1e-9)
    inner = [
        np.asarray(posterior().evaluate({name: value[c, d] for name, value in draws(samples).items()}).u)
        for c, d in np.ndindex(values.shape[:2])
    ]
    np.testing.assert_allclose(samples.u_mean[MESH.interior], np.mean(inner, axis=0)[MESH.interior], rtol=1e-6)


def test_running_rhat_is_the_textbooks():
    """√(var⁺/W) as Gelman et al. write it, from the draws themselves."""
    samples, _ = whole()
    lam = draws(samples)["lam"]
    count = lam.shape[1]
    within = lam.var(axis=1, ddof=1).mean(axis=0)
    between = count * lam.mean(axis=1).var(axis=0, ddof=1)
    expected = np.sqrt(((count - 1) / count * within + between / count) / within)
    np.testing.assert_allclose(samples.rhat["lam"], expected, rtol=1e-9)


def test_statistics_count_what_happened_to_the_proposals():
    samples, _ = whole()
    stats = samples.idata.sample_stats
    assert (samples.tally.steps == 36).all()
    np.testing.assert_array_equal(stats.outside_support.sum("draw"), samples.tally.outside_support)
    # The wall is 0.05 mm from a whole face of the box: most proposals enter it, and none is accepted.
    assert samples.tally.outside_support.sum() > 50
    for d in range(12):
        values = {name: value[0, d] for name, value in draws(samples).items()}
        evaluation = posterior().evaluate(values)
        assert not evaluation.outside_support
        assert float(evaluation.logdensity) == pytest.approx(float(stats.lp[0, d]), rel=1e-9)


def test_stop_rules():
    spent = br.sample(posterior(), draws=1000, block=2, stop=br.StopRule(max_seconds=0.01), **OPTIONS)
    assert spent.idata.posterior.sizes["draw"] == 2
    assert "0.01 s" in spent.reason
    assert spent.converged is None
    loose = br.sample(posterior(), draws=1000, block=10, stop=br.StopRule(rhat=1e9, min_draws=20), **OPTIONS)
    assert loose.idata.posterior.sizes["draw"] == 20
    assert loose.converged is True
    strict = br.sample(posterior(), draws=20, block=10, stop=br.StopRule(rhat=1.0001, min_draws=20), **OPTIONS)
    assert strict.converged is False
    assert "below 1.0001" in strict.reason


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sampler": "mala"}, "unknown sampler 'mala'; there are auto, rwmh, hmc, nuts, gibbs, smc, laplace"),
        ({"chains": 0}, "chains must be at least 1, got 0"),
        ({"thin": 0}, "thin must be at least 1"),
        ({"sigma_u": -1.0}, "sigma_u = -1.0: expected greater than 0"),
        ({"start": br.Start(field=np.zeros((2, 3)))}, "start field must have shape"),
        ({"start": br.Start(field=np.full((26, 3), np.nan))}, "chain 0 cannot start"),
        ({"start": br.Start(lam={"gm": np.nan})}, "chain 0 cannot start: lam is not a number"),
        ({"start": br.Start(lam={"bone": 1.0})}, "names 'bone'"),
    ],
)
def test_wrong_options_are_told(wrong, message):
    with pytest.raises(br.InputError, match=message):
        br.sample(posterior(), **({"draws": 2} | OPTIONS | wrong))


def test_starts_spread_over_the_field_and_stay_out_of_the_skull():
    """The far end of the field crosses the wall: nodes that would enter it stop before it."""
    target, sampled = posterior().target, posterior().sampled
    field = np.zeros((len(sampled), 3))
    field[:, 2] = 2.0
    points = starting_points(target, br.Start(field=field, fraction=(0.0, 1.0)), 3, jax.random.key(0))
    moves = np.asarray(points["u_boundary"])[:, :, 2]
    assert (moves[0] == 0).all()
    assert moves[2].max() == 2.0
    top = MESH.points[sampled, 2] > MESH.points[:, 2].max() - 1e-9
    assert (moves[2, top] < 0.06).all()
    assert jax.vmap(partial(target.supports, target.data))(points).all()


def test_posterior_file_round_trip(tmp_path):
    samples, _ = whole()
    save_posterior(posterior().target, samples.blocks, tmp_path / "posterior.nc")
    idata = open_posterior(tmp_path / "posterior.nc")
    assert set(idata.posterior.data_vars) == {"u_boundary", "lam", "mu", "ratio"}
    assert idata.posterior.u_boundary.dims == ("chain", "draw", "node", "axis")
    np.testing.assert_array_equal(idata.posterior.node, MESH.boundary)
    np.testing.assert_allclose(idata.posterior.u_boundary, samples.idata.posterior.u_boundary, rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(idata.posterior.mu.sel(tissue="gm"), 1.0)
    np.testing.assert_allclose(idata.posterior.ratio, idata.posterior.lam / idata.posterior.mu)
    for name in ("lp", "acceptance_rate", "similarity_energy", "strain_energy", "solver_iterations", "diverging"):
        assert idata.sample_stats[name].dims == ("chain", "draw")
    np.testing.assert_array_equal(idata.constant_data.cells, MESH.cells)


@pytest.mark.long
def test_solves_of_samplers_about_the_mode_are_those_of_their_draws():
    samples = br.sample(posterior_of(1, 0.5), "hmc", chains=2, draws=3, thin=2, progress=False, warm_up=4)
    iterations = samples.idata.sample_stats.solver_iterations.to_numpy()
    assert (iterations >= 1).all()
    assert (iterations == iterations.astype(int)).all()
    assert float(samples.tally.solver_iterations.sum()) == 2 * iterations.sum()


def test_known_entries_have_no_diagnostics():
    judged = convergence(whole()[0].idata)
    assert np.isnan(judged.rhat.mu.sel(tissue="gm"))
    assert np.isfinite(judged.rhat.lam).all()
    assert (judged.ess_bulk.u_boundary > 0).all()
