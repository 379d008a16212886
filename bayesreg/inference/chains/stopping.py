"""When to stop, and why a run did."""

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

# Estimands that are judged before all others.
SUSPECTS = 32
# So much longer is a run when its draws are judged again.
LONGER = 1.05


class StopRule(NamedTuple):
    """When to stop: converged, or out of budget.

    Attributes
    ----------
    rhat : float, optional
        Stop when R̂ is below this for every estimand; None never stops early. Without `ess` it is the paper's,
        √(var⁺/W), unsplit; with it the rank-normalised, split one of Vehtari et al. (2021).
    ess : float, optional
        And when every estimand's bulk and tail effective sample sizes exceed this.
    max_seconds : float, optional
        Seconds of sampling, compilation, search for the mode and warm-up included.
    min_draws : int
        Kept draws per chain before R̂ is believed.
    """

    rhat: float | None = None
    ess: float | None = None
    max_seconds: float | None = None
    min_draws: int = 100


class Verdict(NamedTuple):
    """Whether a rule holds, and the figures of all estimands where these had to be worked out."""

    holds: bool
    found: Figures | None = None


def judge(stop: StopRule, checkpoint: Checkpoint, blocks: Blocks) -> Verdict:
    """The verdict on all draws so far."""
    if stop.rhat is None or int(checkpoint.draws) < stop.min_draws:
        return Verdict(holds=False)
    rhat = scale_reduction(checkpoint.moments)["estimands"]
    running = greatest_rhat(rhat)
    if stop.ess is None:
        return Verdict(running < stop.rhat)
    # The running R̂ is cheap and close to the strict one: where it is far off, that need not be worked out. Nor need it
    # for all estimands where one of the suspects fails.
    if not running < 1 + 1.5 * (stop.rhat - 1) or not _is_due(len(blocks)):
        return Verdict(holds=False)
    if not _meets(figures(blocks, _suspects(rhat)).worst, stop):
        return Verdict(holds=False)
    return judge_all(stop, checkpoint, blocks)


def judge_all(stop: StopRule, checkpoint: Checkpoint, blocks: Blocks) -> Verdict:
    """The verdict on all draws, of all estimands by a rule with effective sample sizes."""
    found = figures(blocks)
    return Verdict(int(checkpoint.draws) >= stop.min_draws and _meets(found.worst, stop), found)


def _is_due(count: int) -> bool:
    """Whether draws are judged after so many blocks: all of them are read for it, so that those must be 5 % more.

    After every one of the first 20; all looks of a run together read some twenty times its draws, however long it is.
    """
    return count <= 20 or math.floor(math.log(count, LONGER)) > math.floor(math.log(count - 1, LONGER))


def _suspects(rhat: Mapping[str, AnyArray]) -> np.ndarray:
    """The estimands of the greatest running R̂, by their place among all, which are sorted by name."""
    return np.argsort(-np.concatenate([rhat[name].ravel() for name in sorted(rhat)]), kind="stable")[:SUSPECTS]


def _meets(found: Worst, stop: StopRule) -> bool:
    if stop.rhat is None or stop.ess is None:
        return False
    return found.rhat < stop.rhat and min(found.ess_bulk, found.ess_tail) > stop.ess


def out_of_time(stop: StopRule, checkpoint: Checkpoint) -> bool:
    """Whether its seconds are spent."""
    # A first block is drawn however long the search for the mode took: a run ends with draws.
    begun = int(checkpoint.draws) > 0
    return begun and stop.max_seconds is not None and float(checkpoint.seconds) >= stop.max_seconds


def reason(stop: StopRule, checkpoint: Checkpoint, verdict: Verdict, draws: int) -> str:
    """Why sampling stopped, in words; `draws` is the greatest number for each chain.

    Of a rule with effective sample sizes the verdict tells the figures of all estimands.
    """
    if stop.ess is None:
        greatest = greatest_rhat(scale_reduction(checkpoint.moments)["estimands"])
        state, rule = f"greatest unsplit R̂ {greatest:.3f}", f"it below {stop.rhat}"
    else:
        assert verdict.found is not None
        found = verdict.found.worst
        state = f"greatest R̂ {found.rhat:.3f}, least ESS {found.ess_bulk:.0f} (bulk), {found.ess_tail:.0f} (tail)"
        rule = f"R̂ below {stop.rhat} and both ESS above {stop.ess:g}"
    if verdict.holds:
        return f"every estimand has converged: {state}"
    limit = f"{draws} draws per chain"
    if out_of_time(stop, checkpoint):
        limit = f"{stop.max_seconds:g} s of sampling"
    if stop.rhat is None:
        return f"the budget of {limit} is spent; no convergence rule was set ({state})"
    return f"the budget of {limit} is spent before convergence: {state}; the rule asks for {rule}"
