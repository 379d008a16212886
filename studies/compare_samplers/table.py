"""The table of the cost of effective draws with each sampler."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from bayesreg.report.tables import Table
from bayesreg.report.verdict import NONE, number, rhat_text
from studies.compare_samplers.efficiency import Efficiency

HEADER = ("", "ESS/s", "ESS/s, all in", "ESS per 1,000 evaluations", "Worst R̂", "All, s", "Rule met, s")


class Setting(NamedTuple):
    """The conditions that all samplers have in common.

    Attributes
    ----------
    name : str
        The name of the posterior.
    chains : int
    minutes : float
        The budget of each sampler.
    rule : str
        The stop rule in words.
    """

    name: str
    chains: int
    minutes: float
    rule: str


def efficiency_table(efficiencies: Sequence[Efficiency], setting: Setting) -> Table:
    """Make a row for each sampler: exact samplers first, ordered by their effective draws per second."""
    ranked = sorted(efficiencies, key=lambda e: -(e.ess_per_second or e.ess_per_second_in_all or 0.0))
    exact = [_row(efficiency) for efficiency in ranked if efficiency.exact is not False]
    approximate = [_row(efficiency) for efficiency in ranked if efficiency.exact is False]
    caption = (
        f"Each sampler has {setting.chains} chains and {setting.minutes:g} minutes on one posterior; it stops earlier "
        f"if it meets the stop rule ({setting.rule}). ESS and R̂ are the worst of all estimands. “All in” includes the "
        "search for the mode, the warm-up and all compilation. An evaluation is one of the density with its gradient, "
        "or of the density alone for samplers without gradients. An ESS is worthless if its R̂ is far above one."
    )
    groups = [(title, rows) for title, rows in (("Exact", exact), ("Approximate", approximate)) if rows]
    return Table("Cost of effective draws", caption, list(HEADER), groups)


def _row(efficiency: Efficiency) -> list[str]:
    if efficiency.note:
        return [efficiency.sampler, *[NONE] * (len(HEADER) - 1)]
    ess_per_thousand = None if efficiency.ess_per_evaluation is None else 1000 * efficiency.ess_per_evaluation
    rhat = NONE if efficiency.rhat is None else rhat_text(efficiency.rhat)
    return [
        efficiency.sampler, number(efficiency.ess_per_second), number(efficiency.ess_per_second_in_all),
        number(ess_per_thousand), rhat, number(efficiency.seconds), number(efficiency.seconds_to_rule),
    ]  # fmt: skip
