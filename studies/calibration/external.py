"""Twelve pairs whose motion no model of this project made: do the intervals hold the truth?

Sag and gravity of `studies.external.make_pair`, three seeds, with and without a shading, registered as a new user
would: files, labels, and no other option. Voxels of one pair are not independent: the spread over pairs is the error of
what is found. Before widening stands the posterior of the nodes alone, after it what displacement_sd.nii.gz holds.
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

Say = Callable[[str], None]

PAIRS = tuple(product(("sag", "gravity"), (21, 22, 23), (0.0, 0.2)))
# Of the pairs under gravity; the hexahedra's own scatter about it by 10 %.
TRUE_RATIO = 1.6
# The 90 % intervals are called right where, in the mean of the pairs, they hold a share between these.
RIGHT = (0.84, 0.96)


class Found(NamedTuple):
    """One pair.

    Attributes
    ----------
    before, after : (3,) arrays
        Shares of the true components inside the central 50, 90 and 95 %, before and after widening.
    sharpness : float
        Root mean square sd over root mean square error.
    error : (3,) array
        mm: mean, 95 % and greatest.
    ratio : (2,) array
        Ends of the 90 % interval of μ of white over grey matter.
    converged : bool
    """

    before: np.ndarray
    after: np.ndarray
    sharpness: float
    error: np.ndarray
    ratio: np.ndarray
    converged: bool


def register_pairs(out: Path, say: Say) -> dict[str, Any]:
    """Make and register every pair that is not there yet, and judge them all."""
    found = {}
    for kind, seed, bias in PAIRS:
        folder = out / "external" / f"{kind}-{seed}-{bias:g}"
        if not (folder / "pair" / "pair.json").exists():
            say(f"{folder.name}: making the pair")
            make_pair(kind, data_folder(), folder / "pair", seed=seed, bias=bias)
        say(f"{folder.name}: registering it")
        result = br.run(configure(folder / "pair"), folder / "run", resume=True, progress=False)
        one = found[folder.name] = judge(folder / "pair", result)
        say(f"{folder.name}: 90 % intervals hold {one.before[1]:.1%}, widened {one.after[1]:.1%}")
    return {"external pairs": summarise(found)}


def configure(pair: Path) -> Config:
    """The configuration of a new user: files and labels."""
    files = {name: str(pair.resolve() / f"{name}.nii.gz") for name in ("fixed", "moving", "labels", "intracranial")}
    content = {"data": {"source": "files", **files, "label_table": TISSUES}, "stop": {"max_minutes": 12.0}}
    path = pair.parent / "run.yaml"
    # JSON is YAML, too.
    path.write_text(json.dumps(content), encoding="utf-8")
    return br.load_config(path)


def judge(pair: Path, result: Result) -> Found:
    """Hold a run against the truth."""
    truth = read_truth(pair)
    mean, sd = (read_field(result.folder / f"displacement_{name}.nii.gz") for name in ("mean", "sd"))
    inside = np.abs(sd).sum(axis=-1) > 0
    of_nodes = np.zeros_like(sd)
    covered = covered_voxels(br.load_image(pair / "fixed.nii.gz"), result.mesh)
    nodal = result.u_sd[result.mesh.cells[covered.cell]]
    of_nodes[tuple(covered.voxel.T)] = np.einsum("qa,qac->qc", covered.barycentric, nodal)
    before, after = (compare(truth, mean, np.abs(one), inside) for one in (of_nodes, sd))
    mu = dataset(result.idata, "posterior")["mu"]
    ratio = (mu.sel(tissue="wm") / mu.sel(tissue="gm")).to_numpy()
    return Found(
        before=np.array(before["coverage_50_90_95"]),
        after=np.array(after["coverage_50_90_95"]),
        sharpness=after["sd_over_rms_error"],
        error=np.array(after["error"]),
        ratio=np.quantile(ratio, (0.05, 0.95)),
        converged=bool(result.converged),
    )


def summarise(found: dict[str, Found]) -> dict[str, Any]:
    """Means over the pairs with their standard errors, and every pair."""
    holds = {name: bool(one.ratio[0] < TRUE_RATIO < one.ratio[1]) for name, one in found.items() if "gravity" in name}
    coverage = np.array([one.after[1] for one in found.values()])
    return {
        "as_it_should": bool(RIGHT[0] <= coverage.mean() <= RIGHT[1]),
        "coverage": {
            part: {
                f"{level:.0%}": _mean_and_error(np.array([getattr(one, part)[row] for one in found.values()]))
                for row, level in enumerate(LEVELS)
            }
            for part in ("before", "after")
        },
        "sharpness": _mean_and_error(np.array([one.sharpness for one in found.values()])),
        "ratio of white over grey held": f"{sum(holds.values())} of {len(holds)}",
        "converged": sum(one.converged for one in found.values()),
        "pairs": {
            name: {key: np.round(np.asarray(value, float), 3).tolist() for key, value in one._asdict().items()}
            for name, one in found.items()
        },
    }


def _mean_and_error(values: np.ndarray) -> list[float]:
    """The mean over pairs, and its standard error."""
    return [float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))]
