"""Landmarks that were observed: residuals beside their sd, and how well all else predicts each."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import stats

from bayesreg.io.records import Predicted
from bayesreg.mesh import TetMesh
from bayesreg.report import style
from bayesreg.report.places import regions
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import NONE, number, percent, place_text
from bayesreg.types import AnyArray

LEVELS = (0.5, 0.95)


def surprise(residual: Float[AnyArray, "k 3"], covariance: Float[AnyArray, "k 3 3"]) -> Float[np.ndarray, "k"]:
    """Probability of a residual nearer to zero than this one, by its covariance; NaN where that is not finite."""
    residual, covariance = np.asarray(residual), np.asarray(covariance)
    known = np.isfinite(covariance).all(axis=(1, 2))
    found = np.full(len(residual), np.nan)
    r = residual[known]
    squared = np.einsum("ki,ki->k", r, np.linalg.solve(covariance[known], r[..., None])[..., 0])
    found[known] = stats.chi2(3).cdf(squared)
    return found


def landmark_table(mesh: TetMesh, predicted: Predicted) -> Table | None:
    """Residual of every landmark at the posterior mean, and where it was left out."""
    if predicted.landmark_names is None:
        return None
    words = regions(mesh, np.asarray(predicted.landmark_points))
    sd, residual = np.asarray(predicted.landmark_sd), np.linalg.norm(np.asarray(predicted.landmark_residual), axis=1)
    points = np.asarray(predicted.landmark_points)
    rows = [
        [
            str(name),
            place_text((float(point[0]), float(point[1]), float(point[2]))),
            words[k],
            number(float(sd[k])),
            number(float(residual[k])),
            *_left_out_cells(predicted, k),
        ]
        for k, (name, point) in enumerate(zip(predicted.landmark_names, points, strict=True))
    ]
    header = ["", "Place (x, y, z)", "Where", "Sd, mm", "Residual, mm", "Left out, mm", "Its region"]
    return Table("Each landmark", _caption(predicted), header, [("", rows)])


def _left_out_cells(predicted: Predicted, k: int) -> list[str]:
    if predicted.left_out_residual is None or predicted.left_out_covariance is None:
        return [NONE, NONE]
    residual = np.asarray(predicted.left_out_residual)[k]
    if not np.isfinite(residual).all():
        return ["not determined", NONE]
    inside = surprise(residual[None], np.asarray(predicted.left_out_covariance)[k : k + 1])[0]
    return [number(float(np.linalg.norm(residual))), percent(float(inside))]


def _caption(predicted: Predicted) -> str:
    text = (
        "Residual: distance of the landmark in the moving image from where the posterior mean takes it; sd: of the "
        "error of each coordinate that the model gives it."
    )
    if predicted.left_out_residual is None or predicted.left_out_covariance is None:
        return f"{text} They were not left out in turn, as up to 60 are where nodes are sampled."
    known = np.isfinite(np.asarray(predicted.left_out_residual)).all(axis=1)
    if not known.any():
        return f"{text} Left out, no landmark is determined by the other observations."
    errors = np.linalg.norm(np.asarray(predicted.left_out_residual)[known], axis=1)
    found = surprise(predicted.left_out_residual, predicted.left_out_covariance)[known]
    shares = [f"{(found <= level).mean():.0%} of the landmarks lie in their {level:.0%} region" for level in LEVELS]
    return (
        f"{text} Left out: the same distance where all other observations predict the landmark, at the mean stiffness; "
        f"its mean is {number(float(errors.mean()))} mm. Its region: the share of the prediction that lies nearer. "
        f"{', '.join(shares)}.".replace("%", " %")
    )


def residuals(predicted: Predicted) -> Drawing | None:
    """Distances with each landmark and without it, beside what the model expects of them."""
    if predicted.landmark_names is None:
        return None
    names = [style.literal(str(name)) for name in predicted.landmark_names]
    sd, fitted = np.asarray(predicted.landmark_sd), np.linalg.norm(np.asarray(predicted.landmark_residual), axis=1)
    rows = np.arange(len(names))
    with style.look():
        figure = style.new_figure(max(1.6, 0.17 * len(names) + 0.9))
        axes = figure.subplots()
        reach = stats.chi(3).ppf(0.95)
        axes.barh(rows, reach * sd, height=0.8, color=style.FAINT, lw=0, label="95 % of errors of this sd")
        axes.plot(fitted, rows, "o", color=style.UNIFORM, ms=4, label="at the posterior mean")
        if predicted.left_out_residual is not None:
            alone = np.linalg.norm(np.asarray(predicted.left_out_residual), axis=1)
            axes.plot(alone, rows, "o", mfc="none", mec=style.ACCENT, ms=5, label="predicted by all others")
        axes.set(yticks=rows, yticklabels=names, xlabel="distance from the landmark, mm", xlim=(0, None))
        axes.invert_yaxis()
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.9 / figure.get_figheight()), ncols=3)
        uri = style.data_uri(figure)
    caption = (
        "How far each landmark lies from where the posterior takes it: with the landmark among the data (dots) and "
        "predicted by all others (rings). Grey: what 95 % of landmarks with this error do not exceed."
    )
    alt = f"Distances of {len(names)} landmarks, with and without each among the data."
    return Drawing("landmarks", "Distances of the landmarks", caption, alt, uri)
