"""Simulation-based calibration of `gibbs` with a surface: a box whose top is measured, without partners.

The truth is drawn by dense matrices that the sampler does not use: u = K⁺ q + R c with random loads q in balance. A
measured point is the place that the displacement takes to its column, and an error of Student's t along the normal.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
from numpyro.diagnostics import effective_sample_size, split_gelman_rubin

import bayesreg as br
from bayesreg.fem.elasticity import stiffness
from bayesreg.fem.location import interpolation_at
from studies.calibration.sbc import Ranks
from tests.phantoms import box_mesh, of_one_tissue

MESH = of_one_tissue(box_mesh(4))
LOW, HIGH = MESH.points.min(axis=0), MESH.points.max(axis=0)
MODEL = br.ModelConfig(
    elasticity="uniform",
    fixed={"mu": 1.0},
    priors={"lam": {"low": 0.5, "high": 10.0}},
    elastic_prior=br.RandomLoads(
        body=br.ScalePrior(median=0.03, log_sd=0.5), surface=br.ScalePrior(median=0.02, log_sd=0.5)
    ),
    rigid_sd=0.5,
)
SD, FREEDOM, POINTS = br.ScalePrior(median=0.2, log_sd=0.4), 4.0, 60
SCALES = ("body_load", "surface_load", "surface_sd")
# Places at which the displacement is ranked: on the measured top, inside, and at the bottom.
PLACES = ((0.5, 0.5, 1.0), (0.0, 0.0, 1.0), (0.5, 0.5, 0.5), (1.0, 0.5, 0.0))
CHAINS, DRAWS = 2, 150


def calibrate(replications: int, report_progress: Callable[[str], None]) -> Ranks:
    """Rank truths among the draws of their posteriors."""
    node = [int(np.linalg.norm(MESH.points - (LOW + np.array(at) * (HIGH - LOW)), axis=1).argmin()) for at in PLACES]
    names = ("lam", *SCALES, *(f"u{k} {axis}" for k in node for axis in "xyz"))
    rows = []
    for replication in range(replications):
        rng = np.random.default_rng(replication)
        truth, points = _simulate(rng)
        posterior = br.build_posterior(
            mesh=MESH, observations=[br.Surface(points, sd=SD)], model=MODEL
        ).with_independent_points({"surface": float(POINTS)})
        drawn = br.sample(posterior, "gibbs", CHAINS, DRAWS, seed=replication, progress=False).idata.posterior
        parameters = np.stack([drawn[name].values.reshape(CHAINS, -1) for name in ("lam", *SCALES)], axis=-1)
        displacements = drawn.u_boundary.sel(node=node).values.reshape(CHAINS, -1, 3 * len(node))
        values = np.concatenate([parameters, displacements], axis=-1)
        true = np.r_[[truth[name] for name in ("lam", *SCALES)], truth["u"][node].ravel()]
        ess, rhat = effective_sample_size(values), split_gelman_rubin(values)
        rows.append((_place(values, true, ess, rng), ess, rhat))
        report_progress(f"surface {replication + 1} of {replications}: least ESS {ess.min():.0f}")
        # Each posterior has shapes of its own.
        jax.clear_caches()
    return Ranks(names, *(np.stack(column) for column in zip(*rows, strict=True)), np.ones(replications))


def _place(values: np.ndarray, true: np.ndarray, ess: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rank the truth among draws that are thinned to as many as are independent."""
    flat, places = values.reshape(-1, values.shape[-1]), []
    for column, value, count in zip(flat.T, true, ess, strict=True):
        thinned = column[:: max(1, int(np.ceil(len(column) / count)))]
        places.append(((thinned < value).sum() + rng.uniform()) / (len(thinned) + 1))
    return np.array(places)


def _simulate(rng: np.random.Generator) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Draw parameters, a displacement and measured points."""
    prior = MODEL.elastic_prior
    scales = {"body_load": prior.body, "surface_load": prior.surface, "surface_sd": SD}
    truth = {name: scale.median * np.exp(scale.log_sd * rng.normal()) for name, scale in scales.items()}
    truth["lam"] = rng.uniform(0.5, 10.0)
    ones = np.ones(len(MESH.cells))
    measured = _places_on_top(rng)
    term = br.build_posterior(mesh=MESH, observations=[br.Surface(measured)], model=MODEL).data.terms["elastic"]
    rigid, masses = np.asarray(term.rigid), np.asarray(term.masses)
    variances = truth["body_load"] ** 2 * masses[0] + truth["surface_load"] ** 2 * masses[1]
    load = np.sqrt(variances) * rng.normal(size=len(variances))
    # Of loads that are balanced, q − D R (Rᵀ D R)⁻¹ Rᵀ q.
    load -= variances * (rigid @ np.linalg.solve(rigid.T @ (variances[:, None] * rigid), rigid.T @ load))
    flexibility = np.linalg.pinv(stiffness(MESH, truth["lam"] * ones, ones).toarray(), rcond=1e-10)
    motion = np.sqrt(len(MESH.points)) * MODEL.rigid_sd * rng.normal(size=6)
    u = truth["u"] = (flexibility @ load + rigid @ motion).reshape(-1, 3)
    # The place on the top that has moved into the column of each point.
    places = measured.copy()
    for _ in range(20):
        nodes, weights = interpolation_at(MESH, np.clip(places, LOW, HIGH))
        shift = np.einsum("ka,kai->ki", weights, u[nodes])
        places[:, :2] = measured[:, :2] - shift[:, :2]
    measured[:, 2] += shift[:, 2] + truth["surface_sd"] * rng.standard_t(FREEDOM, POINTS)
    return truth, measured


def _places_on_top(rng: np.random.Generator) -> np.ndarray:
    margin = 0.2 * (HIGH - LOW)[:2]
    return np.c_[rng.uniform(LOW[:2] + margin, HIGH[:2] - margin, (POINTS, 2)), np.full(POINTS, HIGH[2])]
