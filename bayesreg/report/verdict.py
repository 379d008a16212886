"""The first words of a report: convergence, the key numbers, and warnings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from bayesreg.mesh import TetMesh
from bayesreg.printable import NONE, number, place_text
from bayesreg.report.estimands import Estimand, above, parameter_groups, worst
from bayesreg.tissues import label_of

DEFAULT_THRESHOLD = 1.01
LEAST_ESS = 100.0
NU_LOCKING = 0.48
NOISE_FACTOR = 1.5
UNCONVERGED = (
    "What follows describes where the chains have been so far, not the posterior: "
    "means may still move, and intervals and effective sample sizes are unreliable."
)


class Verdict(NamedTuple):
    """The judgement whether the chains converged.

    Attributes
    ----------
    converged : bool
        Whether R-hat is below the threshold for every estimand, and the run's own stop rule agrees.
    headline : str
        One sentence.
    detail : str
        The reason of the stop, and its meaning for the figures below.
    """

    converged: bool
    headline: str
    detail: str


def decimal_text(value: float | int | None, decimals: int = 2) -> str:
    """Format a number with `decimals` decimals; a dash if it is not finite or missing."""
    return NONE if value is None or not math.isfinite(value) else f"{value:,.{decimals}f}".replace("-", "−")


def percent(value: float | int | None) -> str:
    """Format a fraction as per cent."""
    return NONE if value is None or not math.isfinite(value) else f"{100 * value:.1f} %"


def duration(seconds: float | int | None) -> str:
    """Format seconds as "45 s", "3 min 20 s" or "2 h 05 min"."""
    if seconds is None or not math.isfinite(seconds):
        return NONE
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def nested_entry(manifest: Mapping[str, Any], *keys: str) -> Any:
    """Return a nested entry of the manifest, or None."""
    value: Any = manifest
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def threshold_of(manifest: Mapping[str, Any]) -> float:
    """Return the R-hat threshold of the stop rule; 1.01 without a stop rule."""
    return float(nested_entry(manifest, "stopped", "rhat_threshold") or DEFAULT_THRESHOLD)


def verdict(manifest: Mapping[str, Any], entries: Sequence[Estimand]) -> Verdict:
    """Judge by the estimands, and by the stop rule's own R-hat (unsplit, as in the paper) if it is known.

    With few chains, the rank-normalised R-hat cannot be much greater than one, and the unsplit R-hat misses drifts.
    Both must be low.
    """
    threshold = threshold_of(manifest)
    reason = str(nested_entry(manifest, "stopped", "reason") or "").strip().rstrip(".")
    stopped = f"It stopped because {reason}. " if reason else ""
    if not entries:
        return Verdict(False, "Not converged: no estimand has a convergence figure.", stopped)
    first, failing = worst(entries, 1)[0], above(entries, threshold)
    named = f"{rhat_text(first.rhat)} ({first.name}{_at(first)})"
    if not failing and nested_entry(manifest, "stopped", "converged") is False:
        headline = (
            f"Not converged by the rule of this run: {_missed_rules(manifest, threshold)}, though the rank-normalised "
            f"R̂ is below {threshold:g}; the greatest is {named}."
        )
        return Verdict(False, headline, stopped + UNCONVERGED)
    if not failing:
        headline = f"Converged: R̂ is below {threshold:g} for all {len(entries):,} estimands; the greatest is {named}."
        return Verdict(True, headline, (stopped + _few_draws(entries)).strip())
    headline = (
        f"Not converged: R̂ is {threshold:g} or more for {failing:,} of {len(entries):,} estimands; "
        f"the greatest is {named}."
    )
    return Verdict(False, headline, stopped + UNCONVERGED)


def _missed_rules(manifest: Mapping[str, Any], threshold: float) -> str:
    """Describe the figures that the stop rule required besides the rank-normalised R-hat, and the figures reached."""
    wanted = nested_entry(manifest, "stopped", "ess_threshold")
    if wanted is None:
        return f"its R̂ (unsplit, as in the paper) is {_unsplit(manifest)}, asked for {threshold:g}"
    bulk, tail = (nested_entry(manifest, "convergence", f"ess_{name}_min") for name in ("bulk", "tail"))
    least = f"{decimal_text(bulk, 0)} (bulk) and {decimal_text(tail, 0)} (tail)"
    return f"the least ESS is {least}, asked for more than {wanted:g}"


def _unsplit(manifest: Mapping[str, Any]) -> str:
    return number(nested_entry(manifest, "convergence", "rhat_paper_max"), 4)


def rhat_text(rhat: float) -> str:
    """Format R-hat; "undefined" if a chain never moved."""
    return "undefined" if math.isnan(rhat) else "infinite" if math.isinf(rhat) else number(rhat, 4)


def _at(entry: Estimand) -> str:
    return f" at {place_text(entry.place)}" + (f", {entry.region}" if entry.region else "") if entry.place else ""


def _few_draws(entries: Sequence[Estimand]) -> str:
    least = _least(entries, "ess_bulk")
    if math.isnan(least) or least >= LEAST_ESS:
        return ""
    return f"But the least effective sample size is only {number(least)}: means are rough and the tails rougher."


def _least(entries: Sequence[Estimand], figure: str) -> float:
    values = [getattr(entry, figure) for entry in entries]
    return float(np.nanmin(values)) if values and not np.isnan(values).all() else float("nan")


def key_facts(manifest: Mapping[str, Any], entries: Sequence[Estimand], posterior: xr.Dataset) -> dict[str, str]:
    """Return the key numbers of a run, as text by their labels."""
    entry, sizes = partial(nested_entry, manifest), posterior.sizes
    implied = entry("implied_noise_sd")
    return {
        "Greatest R̂": rhat_text(worst(entries, 1)[0].rhat) + _threshold_text(manifest) if entries else NONE,
        "Least ESS, bulk": number(_least(entries, "ess_bulk"), 2),
        "Least ESS, tail": number(_least(entries, "ess_tail"), 2),
        "Chains × draws": f"{sizes['chain']} × {sizes['draw']:,}",
        "Acceptance inside the support": percent(entry("acceptance", "inside_support")),
        "Acceptance in all": percent(entry("acceptance", "overall")),
        "Nodes in contact with the skull": _count(entry("contact_nodes")),
        "Failed elastic solves": _count(entry("solver", "failed")),
        "Iterations of a solve": number(entry("solver", "iterations_mean")),
        "Time in all": duration(entry("timings", "total")),
        "Time of sampling": duration(entry("timings", "sampling")),
        "Steps per second and chain": number(entry("steps_per_second_per_chain")),
        "Sd of the residual": number(entry("residual_sd")) + (f" (T_s implies {number(implied)})" if implied else ""),
    }


def _threshold_text(manifest: Mapping[str, Any]) -> str:
    threshold, unsplit = nested_entry(manifest, "stopped", "rhat_threshold"), _unsplit(manifest)
    text = f" (asked for {threshold:g}" if threshold else " (none asked for"
    return text + (")" if unsplit == NONE else f"; unsplit, as in the paper, {unsplit})")


def _count(value: float | int | None) -> str:
    return NONE if value is None else f"{int(value):,}"


def approximation(manifest: Mapping[str, Any]) -> str:
    """Return a warning about an approximate sampler; empty if the sampler is exact."""
    if nested_entry(manifest, "exact") is not False:
        return ""
    sampler = nested_entry(manifest, "sampler", "name")
    return (
        f"The draws come from {sampler or 'an approximate sampler'}, which stands in for the posterior of the model: "
        "even with endless draws it would not give exactly that posterior. Intervals may be too narrow or too wide, "
        "and other modes may be missed. Chains that agree, below, show that the draws are many enough, not that they "
        "are right. Sample with an exact sampler before anything is decided by these figures."
    )


def warnings_of(manifest: Mapping[str, Any], mesh: TetMesh, posterior: xr.Dataset) -> list[str]:
    """List all warnings of a run except on convergence: those of its data, and those of its result.

    Parameters
    ----------
    manifest : mapping
        Its entries `appraisal`, `solver`, `inverted_elements`, `residual_to_noise`, `implied_noise_sd`, `model` and
        `pair` are read.
    mesh : TetMesh
    posterior : xarray.Dataset
        With `lam` and `mu`, for Poisson's ratio.
    """
    of_data = list(nested_entry(manifest, "appraisal", "warnings") or [])
    of_result = [*_solver(manifest), *_folding(manifest), *_noise(manifest), *_locking(mesh, posterior)]
    return [*of_data, *_equilibrium(manifest), *of_result]


def _equilibrium(manifest: Mapping[str, Any]) -> list[str]:
    doubt = doubt_of_equilibrium(nested_entry(manifest, "model"), simulated=bool(nested_entry(manifest, "pair")))
    return [] if doubt is None or nested_entry(manifest, "implied_noise_sd") is None else [doubt]


def doubt_of_equilibrium(model: Mapping[str, Any] | None, simulated: bool) -> str | None:
    """Return a warning if real images are registered with a strict equilibrium inside; None otherwise."""
    if simulated or nested_entry(model or {}, "elastic_prior", "nodes") != "boundary":
        return None
    return (
        "The model has the inside in elastic equilibrium exactly (elastic_prior: {nodes: boundary}), as no organ is: "
        "the intervals are those of that model, and much narrower than the error of the displacement. On pairs that no "
        "model made, 90 % intervals have held a fifth of the truth. model.preset: registration lets the inside depart "
        "from it."
    )


def _solver(manifest: Mapping[str, Any]) -> list[str]:
    failed = nested_entry(manifest, "solver", "failed")
    if not failed:
        return []
    return [
        f"{int(failed):,} elastic solves failed and counted as density zero: the posterior near those states is "
        "under-explored. Most often λ or μ of a tissue comes close to zero there: give it a prior with a lower bound "
        "(model.priors), or a known value (model.fixed)."
    ]


def _folding(manifest: Mapping[str, Any]) -> list[str]:
    inverted = nested_entry(manifest, "inverted_elements")
    if not inverted:
        return []
    which = "1 tetrahedron is" if inverted == 1 else f"{inverted:,} tetrahedra are"
    return [
        f"{which} turned inside out by the mean displacement, as no tissue can be: the chains may "
        "sit in a false mode, with nodes far from where they belong. Start from a field (start.field), and compare."
    ]


def _noise(manifest: Mapping[str, Any]) -> list[str]:
    implied, ratio = nested_entry(manifest, "implied_noise_sd"), nested_entry(manifest, "residual_to_noise")
    if not implied or not ratio or 1 / NOISE_FACTOR <= ratio <= NOISE_FACTOR:
        return []
    early = nested_entry(manifest, "stopped", "converged") is False
    return [
        f"T_s implies a noise sd of {number(implied)} (variance T_s / 2w at a quadrature point of weight w), but the "
        f"residual at the mean is {number(ratio, 2)} times as great as such noise: the posterior is too "
        f"{'narrow' if ratio > 1 else 'wide'}. A T_s {number(ratio**2, 2)} times the present one would agree."
        + (" Before convergence this may only show that the chains have not arrived yet." if early else "")
    ]


def _locking(mesh: TetMesh, posterior: xr.Dataset) -> list[str]:
    warnings = []
    for group in parameter_groups(mesh, posterior, max_draws=1000):
        lam, mu = float(np.median(group.lam)), float(np.median(group.mu))
        nu = lam / (2 * (lam + mu)) if mu > 0 else 0.0
        if nu > NU_LOCKING:
            warnings.append(
                f"Poisson’s ratio of {label_of(group.name)} is {nu:.3f} at the medians (λ/μ = {number(lam / mu)}), "
                f"above {NU_LOCKING}: linear tetrahedra lock near incompressibility, and the tissue moves too stiffly."
            )
    return warnings
