"""The rule that stops a run, and the reason why a run stopped."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bayesreg.inference.chains.checkpoint import Checkpoint
from bayesreg.inference.draws.blocks import Blocks
from bayesreg.inference.draws.diagnostics import Figures, Worst, figures
from bayesreg.inference.draws.moments import greatest_rhat, scale_reduction
from bayesreg.types import AnyArray

# The number of estimands that are judged before the others.
SUSPECTS = 32
# The draws are judged again when the run is longer by this factor.
LONGER = 1.05


class StopRule(NamedTuple):
    """The rule that stops a run: convergence, or the end of the budget.

    Attributes
    ----------
    rhat : float, optional
        The run converges when R̂ is below this value for every estimand; with None it never stops early. Without `ess`
        R̂ is the paper's unsplit √(var⁺/W). With `ess` it is the rank-normalised split R̂ of Vehtari et al. (2021).
    ess : float, optional
        Convergence also requires that the bulk and tail effective sample sizes of every estimand exceed this value.
    max_seconds : float, optional
        The greatest time of sampling, s, including compilation, the search for the mode and warm-up.
    min_draws : int
        The least number of kept draws per chain before R̂ is used.
    """

    rhat: float | None = None
    ess: float | None = None
    max_seconds: float | None = None
    min_draws: int = 100


class Verdict(NamedTuple):
    """Whether a stop rule holds, and the figures of all estimands if they were computed."""

    holds: bool
    figures: Figures | None = None


def judge(stop: StopRule, checkpoint: Checkpoint, blocks: Blocks, number: int) -> Verdict:
    """Judge all draws so far by a stop rule; `number` checks were possible so far, this one included."""
    if stop.rhat is None or int(checkpoint.draws) < stop.min_draws:
        return Verdict(holds=False)
    rhat = scale_reduction(checkpoint.moments)["estimands"]
    running = greatest_rhat(rhat)
    if stop.ess is None:
        return Verdict(running < stop.rhat)
    # The running R̂ is cheap and close to the strict one. If it is far from the threshold, or if one of the suspects
    # fails, the strict R̂ of all estimands need not be computed.
    if not running < 1 + 1.5 * (stop.rhat - 1) or not _is_due(number):
        return Verdict(holds=False)
    if not _meets(figures(blocks, _suspects(rhat)).worst, stop):
        return Verdict(holds=False)
    return judge_all(stop, checkpoint, blocks)


def judge_all(stop: StopRule, checkpoint: Checkpoint, blocks: Blocks) -> Verdict:
    """Judge all draws of all estimands by a stop rule with effective sample sizes."""
    all_figures = figures(blocks)
    return Verdict(int(checkpoint.draws) >= stop.min_draws and _meets(all_figures.worst, stop), all_figures)


def _is_due(count: int) -> bool:
    """Check whether draws are judged at the check of this number.

    They are judged at each of the first 20 checks, and then whenever the run is 5 % longer, because each check reads
    all draws. All checks of a run together read about twenty times its draws, whatever its length.
    """
    return count <= 20 or math.floor(math.log(count, LONGER)) > math.floor(math.log(count - 1, LONGER))


def _suspects(rhat: Mapping[str, AnyArray]) -> np.ndarray:
    """Find the estimands with the greatest running R̂, by their index among all estimands sorted by name."""
    return np.argsort(-np.concatenate([rhat[name].ravel() for name in sorted(rhat)]), kind="stable")[:SUSPECTS]


def _meets(worst: Worst, stop: StopRule) -> bool:
    if stop.rhat is None or stop.ess is None:
        return False
    return worst.rhat < stop.rhat and min(worst.ess_bulk, worst.ess_tail) > stop.ess


def out_of_time(stop: StopRule, checkpoint: Checkpoint) -> bool:
    """Check whether the time of a run is spent."""
    # The first draw is made however long the search for the mode took, so that every run has draws.
    begun = int(checkpoint.draws) > 0
    return begun and stop.max_seconds is not None and float(checkpoint.seconds) >= stop.max_seconds


def reason(stop: StopRule, checkpoint: Checkpoint, verdict: Verdict, draws: int) -> str:
    """Describe why sampling stopped; `draws` is the greatest number of draws for each chain.

    For a rule with effective sample sizes the verdict must hold the figures of all estimands.
    """
    if stop.ess is None:
        greatest = greatest_rhat(scale_reduction(checkpoint.moments)["estimands"])
        state, rule = f"greatest unsplit R̂ {greatest:.3f}", f"it below {stop.rhat}"
    else:
        assert verdict.figures is not None
        worst = verdict.figures.worst
        state = f"greatest R̂ {worst.rhat:.3f}, least ESS {worst.ess_bulk:.0f} (bulk), {worst.ess_tail:.0f} (tail)"
        rule = f"R̂ below {stop.rhat} and both ESS above {stop.ess:g}"
    if verdict.holds:
        return f"every estimand has converged: {state}"
    limit = f"{draws} draws per chain"
    if out_of_time(stop, checkpoint):
        limit = f"{stop.max_seconds:g} s of sampling"
    if stop.rhat is None:
        return f"the budget of {limit} is spent; no convergence rule was set ({state})"
    return f"the budget of {limit} is spent before convergence: {state}; the rule asks for {rule}"
