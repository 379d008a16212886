"""The stop rule: suspects first, and all estimands before it holds."""

from itertools import pairwise

import numpy as np
import pytest

from bayesreg.inference.chains import stopping
from bayesreg.inference.chains.checkpoint import Checkpoint, no_steps
from bayesreg.inference.chains.stopping import StopRule, judge, judge_all, reason
from bayesreg.inference.draws.diagnostics import figures, worst
from bayesreg.inference.draws.moments import Moments, greatest_rhat

RULE = StopRule(rhat=1.01, ess=400)
DRAWS = 600


def drawn(shift=0.0, node=17):
    """Four chains of 63 estimands, one of which is off by `shift` standard deviations in one chain."""
    rng = np.random.default_rng(0)
    draws = {name: rng.normal(size=(4, DRAWS, *shape)) for name, shape in (("u_boundary", (20, 3)), ("lam", (3,)))}
    draws = {name: x - x.mean(axis=1, keepdims=True) for name, x in draws.items()}
    draws["u_boundary"][0, :, node, 1] += shift
    mean = {name: x.mean(axis=1) for name, x in draws.items()}
    squares = {name: ((x - x.mean(axis=1, keepdims=True)) ** 2).sum(axis=1) for name, x in draws.items()}
    moments = Moments(np.full(4, DRAWS), {"estimands": mean}, {"estimands": squares})
    blocks = [{name: x[:, draw_range] for name, x in draws.items()} for draw_range in (slice(0, 200), slice(200, None))]
    return Checkpoint(np.array(DRAWS), None, None, moments, no_steps((4,)), np.array(0.0)), blocks


@pytest.fixture
def asked(monkeypatch):
    """How many estimands were judged, each time."""
    counts = []

    def counted(blocks, chosen=None):
        counts.append(63 if chosen is None else len(chosen))
        return figures(blocks, chosen)

    monkeypatch.setattr(stopping, "figures", counted)
    monkeypatch.setattr(stopping, "SUSPECTS", 5)
    return counts


def test_the_rule_holds_of_all_estimands(asked):
    checkpoint, blocks = drawn()
    verdict = judge(RULE, checkpoint, blocks, len(blocks))
    assert verdict.holds
    assert asked == [5, 63]
    assert verdict.figures.worst == worst(blocks)
    assert f"greatest R̂ {verdict.figures.worst.rhat:.3f}" in reason(RULE, checkpoint, verdict, DRAWS)


@pytest.mark.parametrize("node", [0, 17])
def test_the_suspect_is_judged_alone(asked, node):
    checkpoint, blocks = drawn(shift=0.35, node=node)
    verdict = judge(RULE, checkpoint, blocks, len(blocks))
    assert asked == [5]
    assert (verdict.holds, verdict.figures) == (False, None)
    # Sorted by name: the three of lam stand before it.
    assert worst(blocks, np.array([3 + 3 * node + 1])).rhat == worst(blocks).rhat > RULE.rhat
    verdict = judge_all(RULE, checkpoint, blocks)
    assert not verdict.holds
    assert f"greatest R̂ {worst(blocks).rhat:.3f}" in reason(RULE, checkpoint, verdict, DRAWS)


def test_what_no_suspect_shows_is_seen_with_all(asked):
    """A chain of another width: its running R̂, of means, is no greater for it."""
    checkpoint, blocks = drawn()
    for block in blocks:
        block["u_boundary"][1, :, 17, 1] *= 1.5
    assert worst(blocks, np.array([3 + 3 * 17 + 1])).rhat == worst(blocks).rhat > RULE.rhat
    verdict = judge(RULE, checkpoint, blocks, len(blocks))
    assert asked == [5, 63]
    assert not verdict.holds
    assert verdict.figures.worst == worst(blocks)


def test_nothing_is_said_of_one_chain_or_of_no_estimand():
    assert np.isnan(greatest_rhat({"lam": np.zeros(0), "u_boundary": np.full((2, 3), np.nan)}))
    assert np.isnan(greatest_rhat({"u_boundary": np.full((2, 3), np.nan), "lam": np.ones(2)}))
    assert np.isnan(greatest_rhat({"u_boundary": np.zeros((0, 3))}))
    assert greatest_rhat({"lam": np.zeros(0), "u_boundary": np.array([[1.2, np.inf, 1.0]])}) == np.inf


def test_what_is_far_off_is_not_judged(asked):
    checkpoint, blocks = drawn(shift=3.0)
    assert not judge(RULE, checkpoint, blocks, len(blocks)).holds
    assert not judge(RULE, checkpoint._replace(draws=np.array(50)), blocks, len(blocks)).holds
    assert not judge(StopRule(), checkpoint, blocks, len(blocks)).holds
    assert asked == []


def test_long_runs_are_judged_when_they_have_grown(asked):
    """All looks of a run together read its draws so many times, however long it is."""
    checkpoint, blocks = drawn()
    due = [count for count in range(1, 1000) if stopping._is_due(count)]
    assert due[:20] == list(range(1, 21))
    assert all(after / before < 1.11 for before, after in pairwise(due[20:]))
    assert sum(due) < 25 * due[-1]
    late = next(count for count in range(100, 200) if not stopping._is_due(count))
    index_groups = np.array_split(np.arange(DRAWS), late)
    many_blocks = [
        {name: np.concatenate([b[name] for b in blocks], axis=1)[:, indices] for name in blocks[0]}
        for indices in index_groups
    ]
    assert judge(RULE, checkpoint, many_blocks, len(many_blocks)) == (False, None)
    assert asked == []
    assert judge_all(RULE, checkpoint, many_blocks).holds
