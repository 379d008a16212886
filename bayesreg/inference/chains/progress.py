"""A progress bar that shows what matters while chains run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress

from bayesreg.inference.draws.moments import greatest_rhat


@runtime_checkable
class Progress(Protocol):
    """Told of every block."""

    def __enter__(self) -> Progress:
        """Begin."""

    def __exit__(self, *exception: object) -> None:
        """End, also after an error."""

    def show(self, checkpoint: Any, rhat: dict[str, Any]) -> None:
        """Show how far the chains are."""


# Whether progress is shown, or what shows it, made of draws, the most seconds and the threshold of R̂.
Showing = bool | Callable[[int, float | None, float | None], Progress]


class NoProgress:
    """Shows nothing."""

    def __init__(self, draws: int, max_seconds: float | None, threshold: float | None) -> None:
        pass

    def __enter__(self) -> NoProgress:
        return self

    def __exit__(self, *exception: object) -> None:
        return None

    def show(self, checkpoint: Any, rhat: dict[str, Any]) -> None:
        """Nothing."""


class SamplingProgress(NoProgress):
    """Draws, acceptance, steps per second, greatest running R̂ and time left, on one line."""

    def __init__(self, draws: int, max_seconds: float | None, threshold: float | None) -> None:
        self._draws, self._max_seconds, self._threshold = draws, max_seconds, threshold
        self._first: tuple[float, float] | None = None
        self._worst: list[tuple[int, float]] = []
        self._bar = RichProgress(
            TextColumn("sampling"), BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("{task.fields[figures]}"),
            TimeElapsedColumn(), TextColumn("{task.fields[left]}"),
        )  # fmt: skip
        self._task = self._bar.add_task("sampling", total=draws, figures="compiling", left="")

    def __enter__(self) -> SamplingProgress:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def show(self, checkpoint: Any, rhat: dict[str, Any]) -> None:
        """Acceptance inside the support and overall, steps per second of a chain, greatest R̂, time left."""
        draws, seconds, tally = int(checkpoint.draws), float(checkpoint.seconds), checkpoint.tally
        if draws == 0:
            return
        steps = float(np.sum(tally.steps))
        inside = max(steps - float(np.sum(tally.outside_support)), 1.0)
        accepted = float(np.sum(tally.acceptance))
        target = "" if self._threshold is None else f"/{self._threshold:g}"
        worst = greatest_rhat(rhat["estimands"])
        # The first block holds the compilation: rates are taken from its end.
        self._first = self._first or (draws, seconds)
        figures = f"accepted {accepted / steps:.0%} (in support {accepted / inside:.0%})  R̂ {worst:.2f}{target}"
        left = ""
        self._worst.append((draws, worst))
        if draws > self._first[0]:
            rate = (draws - self._first[0]) / max(seconds - self._first[1], 1e-9)
            figures += f"  {rate * steps / draws / len(tally.steps):.0f} steps/s"
            budget = (self._draws - draws) / rate
            if self._max_seconds is not None:
                budget = min(budget, self._max_seconds - seconds)
            needed = draws_until(self._worst, self._threshold)
            left = time_left(budget, None if needed is None else (needed - draws) / rate)
        self._bar.update(self._task, completed=draws, figures=figures, left=left)


def draws_until(seen: Sequence[tuple[int, float]], threshold: float | None) -> float | None:
    """About how many draws of each chain R̂ needs to fall to a threshold; None where that cannot be told.

    What R̂ exceeds one by falls like one over the draws once chains forget where they began. The median over the latest
    looks is taken, which one lucky or unlucky look does not move.

    Parameters
    ----------
    seen : sequence of (int, float)
        Draws and the greatest R̂ at every look so far.
    threshold : float, optional
    """
    latest = [draws * (rhat - 1) for draws, rhat in seen[-5:] if np.isfinite(rhat) and rhat > 1]
    if threshold is None or not latest:
        return None
    return float(np.median(latest)) / (threshold - 1)


def time_left(budget: float, convergence: float | None) -> str:
    """The seconds until convergence, where they are known and fewer, and those of the budget, in words.

    Where R̂ is low enough already and chains go on, it is the effective sample size that they are short of, about which
    nothing is said.
    """
    of_budget = f"{max(budget, 0) / 60:.1f} min to the budget"
    if convergence is None or not 0 < convergence <= budget:
        return of_budget
    return f"about {convergence / 60:.1f} min to convergence, {of_budget}"
