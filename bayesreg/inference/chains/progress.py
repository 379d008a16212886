"""A progress bar with the state of the chains while they run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from rich.progress import Progress as RichProgress
from rich.progress import TextColumn, TimeElapsedColumn

from bayesreg.inference.draws.moments import greatest_rhat


@runtime_checkable
class Progress(Protocol):
    """A display of the progress, called after every block."""

    def __enter__(self) -> Progress:
        """Start the display of the progress."""

    def __exit__(self, *exception: object) -> None:
        """End the display, also after an error."""

    def show(self, checkpoint: Any, rhat: dict[str, Any]) -> None:
        """Show how far the chains are."""


# Whether progress is shown, or the maker of a display: (draws, greatest seconds, threshold of R̂) → Progress.
Showing = bool | Callable[[int, float | None, float | None], Progress]


class NoProgress:
    """A display that shows nothing."""

    def __init__(self, draws: int, max_seconds: float | None, threshold: float | None) -> None:
        pass

    def __enter__(self) -> NoProgress:
        return self

    def __exit__(self, *exception: object) -> None:
        return None

    def show(self, checkpoint: Any, rhat: dict[str, Any]) -> None:
        """Do nothing with the progress."""


class SamplingProgress(NoProgress):
    """A line with draws, acceptance, greatest running R̂ and time left, in 80 columns."""

    def __init__(self, draws: int, max_seconds: float | None, threshold: float | None) -> None:
        self._draws, self._max_seconds, self._threshold = draws, max_seconds, threshold
        self._first: tuple[float, float] | None = None
        self._worst: list[tuple[int, float]] = []
        self._bar = RichProgress(
            TextColumn("{task.completed:.0f} draws"), TextColumn("{task.fields[figures]}"),
            TimeElapsedColumn(), TextColumn("{task.fields[left]}"),
        )  # fmt: skip
        self._task = self._bar.add_task("sampling", total=draws, figures="compiling", left="")

    def __enter__(self) -> SamplingProgress:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def show(self, checkpoint: Any, rhat: dict[str, Any]) -> None:
        """Show the greatest R̂, the time left, and the acceptance: that inside the support, too, if both differ."""
        draws, seconds, tally = int(checkpoint.draws), float(checkpoint.seconds), checkpoint.tally
        if draws == 0:
            return
        steps = float(np.sum(tally.steps))
        inside = max(steps - float(np.sum(tally.outside_support)), 1.0)
        accepted = f"{float(np.sum(tally.acceptance)) / steps:.0%}"
        accepted_inside = f"{float(np.sum(tally.acceptance)) / inside:.0%}"
        target = "" if self._threshold is None else f"/{self._threshold:g}"
        worst = greatest_rhat(rhat["estimands"])
        # The first block includes the compilation, so rates count from its end.
        self._first = self._first or (draws, seconds)
        of_support = "" if accepted_inside == accepted else f" ({accepted_inside} in support)"
        figures = f"accepted {accepted}{of_support}  R̂ {worst:.3f}{target}"
        left = ""
        self._worst.append((draws, worst))
        if draws > self._first[0]:
            rate = (draws - self._first[0]) / max(seconds - self._first[1], 1e-9)
            budget = (self._draws - draws) / rate
            if self._max_seconds is not None:
                budget = min(budget, self._max_seconds - seconds)
            needed = draws_until(self._worst, self._threshold)
            left = time_left(budget, None if needed is None else (needed - draws) / rate)
        self._bar.update(self._task, completed=draws, figures=figures, left=left)


def draws_until(checks: Sequence[tuple[int, float]], threshold: float | None) -> float | None:
    """Estimate the number of draws of each chain at which R̂ falls to a threshold; None if it cannot be estimated.

    R̂ − 1 is inversely proportional to the number of draws once the chains no longer depend on their start points. The
    estimate is the median over the latest five checks, which one extreme R̂ does not change.

    Parameters
    ----------
    checks : sequence of (int, float)
        The draws and the greatest R̂ at every check so far.
    threshold : float, optional
    """
    latest = [draws * (rhat - 1) for draws, rhat in checks[-5:] if np.isfinite(rhat) and rhat > 1]
    if threshold is None or not latest:
        return None
    return float(np.median(latest)) / (threshold - 1)


def time_left(budget: float, convergence: float | None) -> str:
    """Describe the time until convergence, or that in the budget if the former is not known or longer.

    If R̂ is already low enough and the chains continue, the effective sample size is still too small. The text says
    nothing about that.
    """
    if convergence is None or not 0 < convergence <= budget:
        return f"at most {max(budget, 0) / 60:.1f} min left"
    return f"about {convergence / 60:.1f} min left"
