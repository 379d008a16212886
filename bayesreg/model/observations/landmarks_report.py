"""The report on landmarks: residuals with their sd, and the prediction of each by all other observations."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from bayesreg.model.observations.point_noise import WRONG
from bayesreg.model.observations.section import Arrays, ReportFigure, ReportTable
from bayesreg.printable import join_some
from bayesreg.types import AnyArray

LEVELS = (0.5, 0.9, 0.95)
# The probability of all the numbers of landmarks in their regions that chance allows.
CHANCE = 0.99
# The greatest number of landmarks that the figure shows.
MOST_SHOWN = 60


def region_probability(
    residual: Float[AnyArray, "k 3"], covariance: Float[AnyArray, "k 3 3"]
) -> Float[np.ndarray, "k"]:
    """Return the probability of a residual nearer to zero than this one, by its covariance; NaN if not finite."""
    residual, covariance = np.asarray(residual), np.asarray(covariance)
    is_finite = np.isfinite(covariance).all(axis=(1, 2))
    probability = np.full(len(residual), np.nan)
    r = residual[is_finite]
    squared = np.einsum("ki,ki->k", r, np.linalg.solve(covariance[is_finite], r[..., None])[..., 0])
    probability[is_finite] = stats.chi2(3).cdf(squared)
    return probability


def landmark_table(name: str, summary: Arrays) -> ReportTable:
    """Make the table of the residual of every landmark, at the posterior mean and with the landmark left out."""
    distance = np.linalg.norm(summary["residual"], axis=1)
    rows = [
        [str(label), float(sd), float(distance[k]), *_wrong_cell(summary, k), *_left_out_cells(summary, k)]
        for k, (label, sd) in enumerate(zip(summary["names"], summary["sd"], strict=True))
    ]
    header = ["", "Sd, mm", "Residual, mm", *["Wrong"] * ("wrong" in summary), "Left out, mm", "Its region"]
    title = "Each landmark" if name == "landmarks" else f"Each landmark of {name}"
    return ReportTable(title, _caption(summary), header, rows, summary["points"])


def _wrong_cell(summary: Arrays, k: int) -> list[str]:
    return [f"{100 * summary['wrong'][k]:.0f} %"] if "wrong" in summary else []


def _left_out_cells(summary: Arrays, k: int) -> list[Any]:
    if "left_out_share" not in summary:
        return [None, None]
    share = summary["left_out_share"][k]
    if np.isnan(share):
        return ["not determined", None]
    return [float(np.linalg.norm(summary["left_out_residual"][k])), f"{100 * share:.1f} %"]


def _caption(summary: Arrays) -> str:
    text = (
        "Residual: distance of the landmark in the moving image from where the posterior mean takes it; sd: of the "
        "error of each coordinate that the model gives it."
    )
    if "wrong" in summary:
        text += f" {_describe_wrong(summary)}"
    if "left_out_share" not in summary:
        return f"{text} They were not left out in turn: no node is sampled, or there are too many."
    if np.isnan(summary["left_out_share"]).all():
        return f"{text} Left out, no landmark is determined by the other observations."
    probably_right = np.delete(np.arange(len(summary["names"])), _probably_wrong(summary))
    mean = np.nanmean(np.linalg.norm(summary["left_out_residual"][probably_right], axis=1))
    without = " without the probably wrong ones" * (len(probably_right) < len(summary["names"]))
    return (
        f"{text} Left out: the same distance where all other observations predict the landmark (beside images, at the "
        f"mean stiffness and scales, which have seen it); its mean{without} is {mean:.3g} mm. Its region: the share of "
        "landmarks with their own errors, simulated by that prediction, that lie nearer. "
        f"{_describe_coverage(summary)} "
        f"{' '.join(_describe_intervals(summary)) or 'Chance allows such numbers.'}"
    )


def _describe_coverage(summary: Arrays) -> str:
    """Say how many landmarks lie in their regions."""
    held, count = _count_held(summary)
    shares = [
        f"{number} lie in their {level:.0%}".replace("%", " %") for number, level in zip(held, LEVELS, strict=True)
    ]
    return f"Of {count} landmarks, each predicted from the others, {', '.join(shares)} regions."


def _describe_intervals(summary: Arrays) -> list[str]:
    """Say that intervals are too sure or too careful; nothing where chance allows these numbers of landmarks."""
    held, count = _count_held(summary)
    fewest, most = stats.binom(count, LEVELS).interval(CHANCE)
    return [
        f"By chance alone, so {word} would lie in their regions of "
        f"{' and '.join(f'{100 * level:.0f} %' for level in np.array(LEVELS)[found])} less than once in a hundred "
        f"times: the intervals are too {judged}."
        for found, word, judged in ((held < fewest, "few", "sure"), (held > most, "many", "careful"))
        if found.any()
    ]


def _count_held(summary: Arrays) -> tuple[np.ndarray, int]:
    """Count the landmarks in their region of each level, and all that the others determine."""
    share = summary["left_out_share"][~np.isnan(summary["left_out_share"])]
    return (share[:, None] <= LEVELS).sum(axis=0), len(share)


def doubt_intervals(name: str, summary: Arrays) -> list[str]:
    """Return a sentence on intervals that are too sure or too careful; none if they have held."""
    doubts = _describe_intervals(summary) if "left_out_share" in summary else []
    return [f"{name}: {_describe_coverage(summary)} {' '.join(doubts)}"] if doubts else []


def _describe_wrong(summary: Arrays) -> str:
    """Say what a wrong pair is, and name those that probably are."""
    probable = [f"{summary['names'][k]} ({100 * summary['wrong'][k]:.0f} %)" for k in _probably_wrong(summary)]
    named = f"Probably wrong: {', '.join(probable)}." if probable else "None probably is."
    return f"Wrong: the probability that the error of this pair has more than {WRONG:g} times that sd. {named}"


def describe_wrong_pairs(name: str, summary: Arrays) -> list[str]:
    """Return a sentence that names the pairs that are probably wrong; none if there is none."""
    wrong = _probably_wrong(summary)
    if not len(wrong):
        return []
    distance = np.linalg.norm(summary["residual"], axis=1)
    named = [f"{summary['names'][k]} ({distance[k]:.1f} mm, {100 * summary['wrong'][k]:.0f} %)" for k in wrong]
    which = "pair of points is" if len(wrong) == 1 else "pairs of points are"
    return [
        f"{name}: {len(wrong)} {which} probably wrong (distance from where the others have it, probability): "
        f"{join_some(named)}. They count little; look at them again."
    ]


def describe_readings(name: str, summary: Arrays) -> list[str]:
    """Return a sentence with the sd of the readings and the sd that the run inferred; none without a second reading."""
    if "reading_sd" not in summary:
        return []
    read, inferred = (_along_axes(summary[key]) for key in ("reading_sd", "inferred_sd"))
    text = f"{name}: one reading of the moving points has an sd of {read} by both readings"
    if np.isnan(summary["inferred_sd"]).all():
        return [f"{text}."]
    return [f"{text}; the run infers {inferred}, which holds the errors of the fixed points and of the model, too."]


def _along_axes(sd: Float[AnyArray, "3"]) -> str:
    return ", ".join(f"{value:.2g} mm along {axis}" for axis, value in zip("xyz", sd, strict=True) if value == value)


def _probably_wrong(summary: Arrays) -> np.ndarray:
    """Return the numbers of the pairs that are probably wrong, the most probable first."""
    wrong = np.asarray(summary.get("wrong", ()))
    order = np.argsort(-wrong)
    return order[wrong[order] > 0.5]


def distance_figure(name: str, summary: Arrays) -> ReportFigure:
    """Make the figure of the distances with and without each landmark, and of their expected distribution."""
    furthest = np.argsort(-np.linalg.norm(summary["residual"], axis=1))[:MOST_SHOWN]
    chosen = np.sort(furthest)
    count = len(chosen)
    caption = (
        "How far each landmark lies from where the posterior takes it: with the landmark among the data (dots) and "
        "predicted by all others (rings). Grey: what 95 % of landmarks with this error do not exceed."
        + f" The {count} furthest of {len(summary['names'])} are shown."
        * (count < len(summary["names"]))
    )
    alt = f"Distances of {count} landmarks, with and without each among the data."
    height = max(1.6, 0.17 * count + 0.9)
    of_each = ("names", "sd", "residual", "left_out_residual")
    shown = {key: np.asarray(summary[key])[chosen] for key in of_each if key in summary}
    draw = partial(_draw_distances, shown)
    return ReportFigure(f"landmarks-{name}", "Distances of the landmarks", caption, alt, height, draw)


def _draw_distances(summary: Arrays, figure: Any, style: Any) -> None:
    names, axes = [style.literal(str(name)) for name in summary["names"]], figure.subplots()
    rows, reach = np.arange(len(names)), stats.chi(3).ppf(0.95)
    axes.barh(rows, reach * summary["sd"], height=0.8, color=style.FAINT, lw=0, label="95 % of errors of this sd")
    fitted = np.linalg.norm(summary["residual"], axis=1)
    axes.plot(fitted, rows, "o", color=style.UNIFORM, ms=4, label="at the posterior mean")
    if "left_out_residual" in summary:
        predicted = np.linalg.norm(summary["left_out_residual"], axis=1)
        axes.plot(predicted, rows, "o", mfc="none", mec=style.ACCENT, ms=5, label="predicted by all others")
    axes.set(yticks=rows, yticklabels=names, xlabel="distance from the landmark, mm", xlim=(0, None))
    axes.invert_yaxis()
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.9 / figure.get_figheight()), ncols=3)
