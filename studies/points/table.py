"""Rows of the table: the errors of predicted points, and the shares of them in the predicted regions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayesreg.model.observations.landmarks_report import region_probability
from studies.points.peers import Points, Predicted

LEVELS = (0.5, 0.9, 0.95)


class Errors(NamedTuple):
    """What a method did on some points.

    Attributes
    ----------
    away : (k, 3) array
        The points less their predictions, mm.
    covariance : (k, 3, 3) array or None
        That of `away`, mm²; None for a method that states none.
    share : (k,) array or None
        The probability of the smallest region of each prediction that holds the point.
    seconds : float
    """

    away: Points
    covariance: Float[np.ndarray, "k 3 3"] | None
    share: Float[np.ndarray, "k"] | None
    seconds: float


def errors_of(predicted: Predicted, truth: Points, seconds: float) -> Errors:
    """Compare the predictions of a method that takes each axis alone, and has Normal errors."""
    away = truth - predicted.mean
    if predicted.variance is None:
        return Errors(away, None, None, seconds)
    covariance = predicted.variance[:, :, None] * np.eye(3)
    return Errors(away, covariance, region_probability(away, covariance), seconds)


def pool(parts: Sequence[Errors]) -> Errors:
    """Join the errors of a method on several sets, with its mean seconds."""
    *arrays, seconds = zip(*parts, strict=True)
    joined = (None if array[0] is None else np.concatenate(array) for array in arrays)
    return Errors(*joined, seconds=float(np.mean(seconds)))


def describe(name: str, method: str, errors: Errors) -> str:
    """Make a row of the table."""
    error = np.linalg.norm(errors.away, axis=1)
    shares, sd = "", ""
    if errors.covariance is not None and errors.share is not None:
        shares = " / ".join(f"{(errors.share <= level).mean():.1%}" for level in LEVELS)
        sd = f"{np.sqrt(np.trace(errors.covariance, axis1=1, axis2=2).mean()):.2f}"
    figures = [f"{value:.2f}" for value in (error.mean(), np.median(error), np.quantile(error, 0.95))]
    return f"| {' | '.join([name, method, *figures, shares, sd, f'{errors.seconds:.0f}'])} |"
