"""Compare held-out landmarks with their predicted positions: the actual and the expected distances."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesreg.io.point_formats import PointPairs
from bayesreg.results.transform import Transform, spread
from bayesreg.types import AnyArray, InputError

# The name of the held-out landmarks among the points of a run's inputs; no observation has this name.
NAME = "evaluation"
# Landmarks with a smaller distance are the same landmark, mm.
SAME = 1e-3


def require_unseen(held_out: PointPairs, observed: Mapping[str, tuple[AnyArray, AnyArray]]) -> None:
    """Raise InputError if a held-out landmark is also observed; `observed` holds the (fixed, moving) points by name."""
    for name, (fixed, moving) in observed.items():
        away = np.linalg.norm(held_out.fixed[:, None] - np.asarray(fixed), axis=2)
        away += np.linalg.norm(held_out.moving[:, None] - np.asarray(moving), axis=2)
        if count := int((away.min(axis=1) < SAME).sum()):
            raise InputError(
                f"{count} of the {len(away)} landmarks of evaluation are in the observation {name!r}, too: what the "
                "sampler has seen is not held out; give others, or take them out of one of the two files"
            )


def evaluate_landmarks(pairs: PointPairs, transform: Transform, sd: float | None) -> dict[str, AnyArray]:
    """Compute the entries of `Predicted` for held-out landmarks.

    Parameters
    ----------
    pairs : PointPairs
        The landmarks as given, the points of each image in the world of this image.
    transform : Transform
        The transform from the fixed image's world.
    sd : float or None
        Standard deviation of the localisation error of each coordinate, mm; None takes the file's value, else zero.
    """
    predicted = spread(transform, pairs.fixed)
    landmark_sd = pairs.sd if sd is None else np.full(len(pairs.fixed), sd)
    variance = np.zeros(len(pairs.fixed)) if landmark_sd is None else np.square(landmark_sd)
    return {
        "evaluation_names": np.array([name or str(number) for number, name in enumerate(pairs.names, start=1)]),
        "evaluation_points": pairs.fixed,
        "evaluation_before": np.linalg.norm(pairs.moving - pairs.fixed, axis=1),
        "evaluation_posed": np.linalg.norm(pairs.moving - transform.pose.place(pairs.fixed), axis=1),
        "evaluation_residual": pairs.moving - predicted.places,
        "evaluation_covariance": predicted.covariance + variance[:, None, None] * np.eye(3),
        "evaluation_inside": predicted.inside,
    }
