"""Target registration error at held-out landmarks, before and after the registration, and its expected size."""

from __future__ import annotations

import numpy as np
from scipy import stats

from bayesreg.io.records import Predicted
from bayesreg.model.observations.landmarks_report import region_probability
from bayesreg.report import style
from bayesreg.report.study import Study
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import decimal_text
from bayesreg.results.transform import distances_of

LEVELS = (0.5, 0.9, 0.95)


def evaluation_table(study: Study) -> Table | None:
    """Make the table of the target registration errors, mm, at the held-out landmarks; None if there are none.

    Its rows are the errors if the images are aligned by their headers, by the pose alone, and by the posterior mean.
    """
    predicted = study.predicted
    if predicted.evaluation_residual is None:
        return None
    inside, after = np.asarray(predicted.evaluation_inside), np.linalg.norm(predicted.evaluation_residual, axis=1)
    outside = int((~inside).sum())
    if not inside.any():
        caption = (
            f"None of the {outside} landmarks that were held out lies in the mesh; displacements are known only there."
        )
        return Table("Target registration error", caption, [""], [])
    rows = [
        [name, *(decimal_text(float(value)) for value in (x.mean(), np.median(x), np.quantile(x, 0.95), x.max()))]
        for name, x in {
            "By the coordinates as given": np.asarray(predicted.evaluation_before)[inside],
            "By the pose alone": np.asarray(predicted.evaluation_posed)[inside],
            "By the posterior mean": after[inside],
        }.items()
    ]
    probability = _region_probability(predicted)
    shares = [f"{(probability <= level).mean():.0%} lie in their regions of {level:.0%}" for level in LEVELS]
    caption = (
        f"Distances, mm, of predicted places from where {len(probability)} landmarks lie in the moving image. The "
        "sampler never saw these landmarks. The posterior gives every landmark a region of each probability. Of the "
        f"landmarks, {', '.join(shares).replace('%', ' %')}."
    )
    if outside:
        caption += f" {outside} more lie outside the mesh, where nothing is known, and are left out."
    return Table("Target registration error", caption, ["", "Mean", "Median", "95 %", "Greatest"], [("", rows)])


def evaluation(study: Study) -> Drawing | None:
    """Draw the errors against their expected 95 % radii, mm, and a calibration curve.

    Return None if no landmark in the mesh was held out.
    """
    predicted = study.predicted
    if predicted.evaluation_residual is None or predicted.evaluation_posed is None:
        return None
    inside = np.asarray(predicted.evaluation_inside)
    if not inside.any():
        return None
    after = np.linalg.norm(predicted.evaluation_residual, axis=1)[inside]
    radius = distances_of(np.asarray(predicted.evaluation_covariance)[inside]).radius
    probability = np.sort(_region_probability(predicted))
    count = len(probability)
    with style.look():
        figure = style.new_figure(3.4)
        left, right = figure.subplots(1, 2)
        left.plot(radius, after, "o", ms=4, color=style.ACCENT)
        reach = 1.05 * max(radius.max(initial=0.1), after.max(initial=0.1))
        left.plot([0, reach], [0, reach], color=style.MUTED, lw=0.8)
        left.set(
            xlabel="95 % radius, mm",
            ylabel="error, mm",
            xlim=(0, reach),
            ylim=(0, reach),
            title="error and expectation",
        )
        nominal = np.linspace(0, 1, 101)
        low, high = (stats.binom.ppf(edge, count, nominal) / max(count, 1) for edge in (0.025, 0.975))
        right.fill_between(nominal, low, high, color=style.FAINT, lw=0)
        right.plot(nominal, nominal, color=style.MUTED, lw=0.8)
        right.step(
            [0, *probability, 1], [0, *(np.arange(1, count + 1) / max(count, 1)), 1], where="post", color=style.ACCENT
        )
        right.set(
            xlabel="probability of the region", ylabel="share of landmarks in it", title="calibration", aspect="equal"
        )
        uri = style.data_uri(figure)
    caption = (
        "Left: the error of each landmark against the radius that the error should not exceed with a probability of "
        "95 %. Landmarks below the line have a smaller error. Right: the share of landmarks that lie in their regions "
        "of each probability. At each probability, 95 % of such curves lie in the grey band if the probabilities are "
        "right."
    )
    alt = f"Errors of {len(after)} landmarks that were held out, and how often the landmarks lie in their regions."
    return Drawing("held-out", "Landmarks that were held out", caption, alt, uri)


def _region_probability(predicted: Predicted) -> np.ndarray:
    """Return, for each held-out landmark in the mesh, the probability of the smallest region that contains it."""
    inside = np.asarray(predicted.evaluation_inside)
    residual, covariance = (
        np.asarray(x)[inside] for x in (predicted.evaluation_residual, predicted.evaluation_covariance)
    )
    return region_probability(residual, covariance)
