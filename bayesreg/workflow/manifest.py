"""Collect the content of run.json."""

from __future__ import annotations

import hashlib
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayesreg import __version__
from bayesreg.config import Config
from bayesreg.config.sections import StopConfig
from bayesreg.inference.chains.run import Samples
from bayesreg.inference.draws.diagnostics import Convergence
from bayesreg.inference.draws.moments import greatest_rhat
from bayesreg.inference.samplers.registry import choose_sampler
from bayesreg.io.records import Inputs
from bayesreg.mesh import TetMesh, signed_volumes
from bayesreg.model.adequacy import describe_observations
from bayesreg.model.blocks import Scale, Values
from bayesreg.model.posterior import Posterior

# A sampled node is in contact if the distance from its mean position to the skull is smaller, mm.
CONTACT = 0.5


def manifest(
    config: Config,
    inputs: Inputs,
    posterior: Posterior,
    samples: Samples,
    draws: Float[np.ndarray, "draws nodes 3"],
    mean: Values,
    judged: Convergence,
    provenance: dict[str, Any],
    began: float,
) -> dict[str, Any]:
    """Collect the content of run.json: versions, digests, timings, and the quality of the sampling.

    Parameters
    ----------
    config : Config
    inputs : Inputs
    posterior : Posterior
    samples : Samples
    draws : (d, n, 3) array
        Some draws of the displacement of every node, mm.
    mean : mapping
        Values of all blocks at the mean of the draws.
    judged : Convergence
    provenance : dict
        "timings" (s) of the preparation, properties of a synthetic "pair", and the "appraisal" of labels and images.
    began : float
        `time.perf_counter()` at the beginning of the run, minus the seconds that interrupted processes spent on it.
    """
    tally = samples.tally
    steps, outside = float(tally.steps.sum()), float(tally.outside_support.sum())
    accepted = float(tally.acceptance.sum())
    greatest = _extreme(judged.rhat, np.nanmax)
    observations = describe_observations(posterior, mean)
    # Only pairs of images have these figures; the first pair stands for the run.
    of_images = next((observation for observation in observations.values() if "noise_sd" in observation), {})
    return {
        "name": config.description,
        "versions": _versions(),
        "seed": config.seed,
        "mesh_digest": inputs.mesh.digest,
        "image_digests": {
            name: image.digest for name in ("fixed", "moving") if (image := getattr(inputs, name)) is not None
        },
        "config_digest": hashlib.sha256(inputs.config.encode()).hexdigest(),
        "devices": [str(device) for device in jax.devices()],
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "machine": platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "timings": {
            **provenance["timings"],
            "sampling": samples.seconds,
            "total": time.perf_counter() - began,
        },
        "pair": provenance["pair"],
        "appraisal": provenance.get("appraisal", {}),
        "sampler": _describe_sampler(config, posterior),
        "model": config.model.with_default_priors(inputs.mesh.names).model_dump(mode="json"),
        "observations": observations,
        "scales": {
            name: {"median": float(block.median), "log_sd": float(block.log_sd)}
            for name, block in posterior.data.blocks.items()
            if isinstance(block, Scale) and block.is_sampled
        },
        "independent_points": posterior.independent_points,
        "exact": samples.exact,
        "stopped": {
            "reason": samples.reason,
            "converged": _has_converged(samples, config.stop, judged),
            "rhat_threshold": config.stop.rhat,
            "ess_threshold": config.stop.ess,
        },
        "convergence": {
            "rhat_max": greatest,
            "ess_bulk_min": _extreme(judged.ess_bulk, np.nanmin),
            "ess_tail_min": _extreme(judged.ess_tail, np.nanmin),
            "rhat_paper_max": greatest_rhat(samples.rhat),
        },
        "acceptance": {"overall": accepted / steps, "inside_support": accepted / max(steps - outside, 1)},
        "contact_nodes": _contact_nodes(posterior, samples),
        "inverted_elements": _inverted_elements(posterior, samples),
        "inverted_share_of_draws": inverted_share(posterior.mesh, draws),
        "solver": {
            "failed": int(tally.solver_failed.sum()),
            "iterations_mean": float(tally.solver_iterations.sum()) / steps,
        },
        "steps_per_chain": int(tally.steps[0]),
        "gradients_per_chain": float(np.mean(tally.gradients)),
        "steps_per_second_per_chain": float(tally.steps[0]) / samples.seconds,
        "residual_sd": of_images.get("residual_sd"),
        "implied_noise_sd": of_images.get("noise_sd"),
        "residual_to_noise": of_images.get("residual_to_noise"),
    }


def _describe_sampler(config: Config, posterior: Posterior) -> dict[str, Any]:
    """Return the name and the settings of the sampler that was chosen."""
    chosen = choose_sampler(config.sampler.name, posterior.target, **config.sampler.settings)
    common = config.sampler.model_dump(exclude={"name", *config.sampler.settings})
    return {"name": chosen.name, "settings": common | chosen.settings.model_dump()}


def _has_converged(samples: Samples, stop: StopConfig, judged: Convergence) -> bool | None:
    """Decide whether both the stop rule and the report's rank-normalised, split figures show convergence."""
    if stop.rhat is None:
        return None
    greatest = _extreme(judged.rhat, np.nanmax)
    least = [_extreme(ess, np.nanmin) for ess in (judged.ess_bulk, judged.ess_tail)]
    enough = stop.ess is None or all(ess is not None and ess > stop.ess for ess in least)
    return bool(samples.converged) and greatest is not None and greatest < stop.rhat and enough


def _versions() -> dict[str, str]:
    packages = ("jax", "numpyro", "blackjax", "arviz", "numpy", "scipy", "pytetwild")
    return {"bayesreg": __version__, "python": platform.python_version(), **{name: version(name) for name in packages}}


def _extreme(figures: Any, choose: Callable[[np.ndarray], float]) -> float | None:
    values = np.concatenate([np.ravel(figures[name]) for name in figures])
    return float(choose(values)) if np.isfinite(values).any() else None


def _inverted_elements(posterior: Posterior, samples: Samples) -> int:
    mesh = posterior.mesh
    return int((signed_volumes(mesh.points + samples.u_mean, mesh.cells) <= 0).sum())


def inverted_share(mesh: TetMesh, draws: Float[np.ndarray, "draws nodes 3"]) -> float:
    """Compute the mean share of inverted tetrahedra, from draws of the displacement of every node, mm."""
    return float(np.mean([(signed_volumes(mesh.points + u, mesh.cells) <= 0).mean() for u in draws]))


def _contact_nodes(posterior: Posterior, samples: Samples) -> int | None:
    skull = posterior.data.terms.get("skull")
    if skull is None:
        return None
    return int((np.asarray(skull.gap(jnp.asarray(samples.u_mean[posterior.sampled]))) < CONTACT).sum())
