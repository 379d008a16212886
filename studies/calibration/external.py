"""Twelve pairs whose motion no model of this project made: do the intervals hold the truth?

The pairs are sag and gravity of `studies.external.make_pair`, with three seeds, with and without a shading. They are
registered as by a new user: with files, labels, and no other option. The voxels of one pair are not independent, so
that the scatter over pairs gives the standard errors. “Before” is the posterior of the nodes alone; “after” is
displacement_sd.nii.gz, which is wider.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesreg as br
from bayesreg.config import Config
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.model.warp import covered_voxels
from bayesreg.results.result import Result
from studies.external.make_pair import data_folder, make_pair
from studies.external.score import LEVELS, TISSUES, compare, read_field, read_truth

Progress = Callable[[str], None]

PAIRS = tuple(product(("sag", "gravity"), (21, 22, 23), (0.0, 0.2)))
# μ of white over grey matter in the pairs under gravity; the ratios of the hexahedra scatter about it by 10 %.
TRUE_RATIO = 1.6
# The mean coverage of the 90 % intervals must lie between these.
RIGHT = (0.84, 0.96)


class PairResult(NamedTuple):
    """The scores of one pair.

    Attributes
    ----------
    before, after : (3,) arrays
        The shares of the true components inside the central 50, 90 and 95 %, before and after widening.
    sharpness : float
        Root mean square sd over root mean square error.
    error : (3,) array
        The mean, the 95 % quantile and the greatest error, mm.
    ratio : (2,) array
        The ends of the 90 % interval of μ of white over grey matter.
    converged : bool
    """

    before: np.ndarray
    after: np.ndarray
    sharpness: float
    error: np.ndarray
    ratio: np.ndarray
    converged: bool


def register_pairs(out: Path, report_progress: Progress) -> dict[str, Any]:
    """Make and register every pair that does not exist yet, and score all pairs."""
    results = {}
    for kind, seed, bias in PAIRS:
        folder = out / "external" / f"{kind}-{seed}-{bias:g}"
        if not (folder / "pair" / "pair.json").exists():
            report_progress(f"{folder.name}: making the pair")
            make_pair(kind, data_folder(), folder / "pair", seed=seed, bias=bias)
        report_progress(f"{folder.name}: registering it")
        result = br.run(configure(folder / "pair"), folder / "run", resume=True, progress=False)
        pair_result = results[folder.name] = judge(folder / "pair", result)
        report_progress(
            f"{folder.name}: 90 % intervals hold {pair_result.before[1]:.1%}, widened {pair_result.after[1]:.1%}"
        )
    return {"external pairs": summarise(results)}


def configure(pair: Path) -> Config:
    """The configuration of a new user, with files and labels."""
    files = {name: str(pair.resolve() / f"{name}.nii.gz") for name in ("fixed", "moving", "labels", "intracranial")}
    content = {"data": {"source": "files", **files, "label_table": TISSUES}, "stop": {"max_minutes": 12.0}}
    path = pair.parent / "run.yaml"
    # JSON is YAML, too.
    path.write_text(json.dumps(content), encoding="utf-8")
    return br.load_config(path)


def judge(pair: Path, result: Result) -> PairResult:
    """Score a run against the truth."""
    truth = read_truth(pair)
    mean, sd = (read_field(result.folder / f"displacement_{name}.nii.gz") for name in ("mean", "sd"))
    inside = np.abs(sd).sum(axis=-1) > 0
    of_nodes = np.zeros_like(sd)
    covered = covered_voxels(br.load_image(pair / "fixed.nii.gz"), result.mesh)
    nodal = result.u_sd[result.mesh.cells[covered.cell]]
    of_nodes[tuple(covered.voxel.T)] = np.einsum("qa,qac->qc", covered.barycentric, nodal)
    before, after = (compare(truth, mean, np.abs(deviation), inside) for deviation in (of_nodes, sd))
    mu = dataset(result.idata, "posterior")["mu"]
    ratio = (mu.sel(tissue="wm") / mu.sel(tissue="gm")).to_numpy()
    return PairResult(
        before=np.array(before["coverage_50_90_95"]),
        after=np.array(after["coverage_50_90_95"]),
        sharpness=after["sd_over_rms_error"],
        error=np.array(after["error"]),
        ratio=np.quantile(ratio, (0.05, 0.95)),
        converged=bool(result.converged),
    )


def summarise(results: dict[str, PairResult]) -> dict[str, Any]:
    """Return the means over the pairs with their standard errors, and the scores of every pair."""
    holds = {
        name: bool(pair_result.ratio[0] < TRUE_RATIO < pair_result.ratio[1])
        for name, pair_result in results.items()
        if "gravity" in name
    }
    coverage = np.array([pair_result.after[1] for pair_result in results.values()])
    return {
        "as_it_should": bool(RIGHT[0] <= coverage.mean() <= RIGHT[1]),
        "coverage": {
            stage: {
                f"{level:.0%}": _mean_and_error(
                    np.array([getattr(pair_result, stage)[row] for pair_result in results.values()])
                )
                for row, level in enumerate(LEVELS)
            }
            for stage in ("before", "after")
        },
        "sharpness": _mean_and_error(np.array([pair_result.sharpness for pair_result in results.values()])),
        "ratio of white over grey held": f"{sum(holds.values())} of {len(holds)}",
        "converged": sum(pair_result.converged for pair_result in results.values()),
        "pairs": {
            name: {key: np.round(np.asarray(value, float), 3).tolist() for key, value in pair_result._asdict().items()}
            for name, pair_result in results.items()
        },
    }


def _mean_and_error(values: np.ndarray) -> list[float]:
    """Return the mean over pairs and its standard error."""
    return [float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))]
