"""The density that a run sampled, in symbols, and how each observation fits."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from bayesreg.report.tables import Table
from bayesreg.report.verdict import NONE, number, part

E_S = {
    "ssd": "∫ (<var>f</var> − <var>m</var>(<var>x</var> + <var>u</var>))² d<var>x</var>, by quadrature over the mesh",
    "student_t": "<var>T</var><sub>s</sub> (ν+1)/2 Σ log(1 + 2<var>wr</var>² / (ν<var>T</var><sub>s</sub>)), where "
    "<var>r</var> = <var>f</var> − <var>m</var>(<var>x</var> + <var>u</var>) at a quadrature point of weight "
    "<var>w</var>: Student’s t",
    "lncc": "Σ <var>wr</var>², where <var>r</var> is what the best affine map of <var>m</var>(<var>x</var> + "
    "<var>u</var>) leaves of <var>f</var> in the window of a quadrature point of weight <var>w</var>",
    "mi": "−<var>T</var><sub>s</sub> <var>N I</var>, where <var>I</var> is the mutual information of <var>f</var> and "
    "<var>m</var>(<var>x</var> + <var>u</var>) at <var>N</var> quadrature points",
    "mind": "∫ (MIND<sub>r</sub>(<var>f</var>) − MIND<sub>r</sub>(<var>m</var>)(<var>x</var> + <var>u</var>))² "
    "d<var>x</var>, by quadrature over the mesh, whose points look at one neighbour <var>r</var> each",
}
KINDS = {"images": "pair of images", "landmarks": "pairs of points", "own": "an observation of your own"}


def formula(manifest: Mapping[str, Any], elastography: bool) -> Markup:
    """The logarithm of the density as a sum of its terms.

    Parameters
    ----------
    manifest : mapping
    elastography : bool
        Whether the displacement of the boundary is given, and so has no prior.
    """
    observed, model = part(manifest, "observations") or {}, part(manifest, "model") or {}
    several = len(_pairs_of_images(manifest)) > 1
    found = Markup("")
    for name, one in observed.items():
        if one["kind"] == "images":
            pair = Markup("({})").format(name) if several else ""
            found += Markup(" − <var>E</var><sub>s</sub>{} / <var>T</var><sub>s</sub>").format(pair)
        else:
            found += Markup(" + log p({} | <var>u</var>)").format(name)
    loads = model.get("elastic_prior") == "loads"
    priors = {
        " + log p(<var>u</var> | λ, μ, random loads)": loads,
        " − <var>E</var><sub>r</sub> / <var>T</var><sub>r</sub>": not loads,
        " − log <var>Z</var>(λ, μ, <var>T</var><sub>r</sub>)": model.get("normalised") and not loads,
        " + log p(rigid motion of <var>u</var>)": model.get("rigid_sd") is not None,
    }
    found += Markup("".join(text for text, holds in priors.items() if holds and not elastography))
    total = found + Markup(" + log p(λ) + log p(μ)") + _priors_of_scales(model)
    return Markup(re.sub("^ − ", "−", total).removeprefix(" + "))


def _priors_of_scales(model: Mapping[str, Any]) -> Markup:
    symbols = {"t_similarity": Markup("<var>T</var><sub>s</sub>"), "t_elastic": Markup("<var>T</var><sub>r</sub>")}
    sampled = [name for name, value in model.items() if isinstance(value, Mapping) and "log_sd" in value]
    return Markup("").join(Markup(" + log p({})").format(symbols.get(name, name.replace("_", " "))) for name in sampled)


def similarity_energy(manifest: Mapping[str, Any]) -> Markup | None:
    """E_s in symbols; None where no images were compared."""
    return Markup(E_S[manifest["model"]["similarity"]]) if _pairs_of_images(manifest) else None


def observation_table(manifest: Mapping[str, Any]) -> Table | None:
    """How each observation fits at the posterior mean; None where the run does not say."""
    observed = part(manifest, "observations")
    if not observed:
        return None
    rows = [
        [
            name.replace("_", " "),
            KINDS[one["kind"]],
            f"{one['values']:,}" if "values" in one else NONE,
            number(one["residual_rms"]) if "residual_rms" in one else NONE,
            NONE if one["log"] is None else number(one["log"]),
        ]
        for name, one in observed.items()
    ]
    caption = (
        "At the posterior mean. Residual over sd: the root mean square of the residuals in units of the sd that the "
        "model gives them; about 1 where the model holds, less where there are many unknowns to so many values. Log: "
        "of the term of the density, up to its constant."
    )
    return Table("What was observed", caption, ["", "Kind", "Values", "Residual over sd", "Log"], [("", rows)])


def _pairs_of_images(manifest: Mapping[str, Any]) -> list[str]:
    return [name for name, one in (part(manifest, "observations") or {}).items() if one["kind"] == "images"]
