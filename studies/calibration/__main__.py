"""`make calibrate`: simulation-based calibration and Geweke's test, with figures and a JSON file.

python -m studies.calibration -o DIR [--parts sbc geweke pairs same_mesh mesh_share external carried]

Its status is 1 where a part fails.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import bayesreg as br
from studies.calibration import carried, external, figures, geweke, mesh_share, pairs, sbc
from studies.calibration.simulator import T_SIMILARITY, VARIANTS, Simulator, calibrated

# Wrong on purpose, and to be found out: T_s held at 1.5 times its true value, the elastic prior without its normaliser.
PLANTED: dict[str, dict[str, Any]] = {
    "T_s 1.5 times too high": {"t_similarity": 1.5 * T_SIMILARITY},
    "not normalised": {"normalised": False},
}
# How many steps of each kernel: as many as move its chains by about one standard deviation. A wrong one drifts from
# where it starts as long as it goes on.
GEWEKE_STEPS = {"rwmh": 60, "hmc": 10, "nuts": 10}
PLANTED_STEPS = 40

# The pairs take most of an hour, and they and what explains them are asked for by name.
DEFAULT = ["sbc", "geweke"]

BEGAN = time.perf_counter()


def say(text: str) -> None:
    """Progress, with the minutes so far."""
    print(f"{(time.perf_counter() - BEGAN) / 60:5.1f} min  {text}", flush=True)


def calibrate_by_simulation(out: Path) -> dict[str, Any]:
    """Ranks and coverage of every variant, and of the planted errors."""
    runs: dict[str, sbc.Ranks] = {}
    for name, variant in VARIANTS.items():
        say(f"calibration: {name}")
        runs[name] = sbc.calibrate(Simulator(variant), say=say)
    for name, options in PLANTED.items():
        say(f"calibration, planted error: {name}")
        variant = VARIANTS["no skull"]
        posterior, settings = calibrated(variant, **options), sbc.Settings(replications=100)
        runs[name] = sbc.calibrate(Simulator(variant), posterior, settings, say=say)
    found = {}
    for name, ranks in runs.items():
        figures.rank_histograms(ranks, out / f"ranks_{name.replace(' ', '_')}.png")
        found[name] = _summary(ranks, planted=name in PLANTED)
        say(f"{name}: {found[name]['verdict']}; least p {found[name]['least_p']:.2g}")
    figures.coverage(runs, out / "coverage.png")
    return found


def _summary(ranks: sbc.Ranks, planted: bool) -> dict[str, Any]:
    verdict = sbc.verdict(ranks.place)
    failing = (verdict.histogram < verdict.threshold) | (verdict.coverage_p < verdict.threshold).any(axis=0)
    return {
        "as_it_should": verdict.passes != planted,
        "verdict": "uniform" if verdict.passes else "not uniform",
        "replications": len(ranks.place),
        "threshold": verdict.threshold,
        "least_p": min(float(verdict.histogram.min()), float(verdict.coverage_p.min())),
        "failing": [name for name, fails in zip(ranks.names, failing, strict=True) if fails],
        "coverage": {
            f"{level:.0%}": float(row.mean()) for level, row in zip(sbc.LEVELS, verdict.coverage, strict=True)
        },
        "p": dict(zip(ranks.names, verdict.histogram.tolist(), strict=True)),
        "ess": dict(zip(("least", "5 %", "median"), np.quantile(ranks.ess, [0, 0.05, 0.5]).tolist(), strict=True)),
        "rhat_99": float(np.quantile(ranks.rhat, 0.99)),
        "acceptance": dict(zip(("least", "median"), np.quantile(ranks.acceptance, [0, 0.5]).tolist(), strict=True)),
    }


def compare_simulators(out: Path) -> dict[str, Any]:
    """Geweke's test of each kernel, with the skull, and of a planted error."""
    simulator, found = Simulator(VARIANTS["skull"]), {}
    trials: dict[str, tuple[str, br.Posterior | None]] = {name: (name, None) for name in GEWEKE_STEPS}
    wrong = calibrated(VARIANTS["skull"], **PLANTED["T_s 1.5 times too high"])
    trials["hmc, T_s 1.5 times too high"] = ("hmc", wrong)
    for name, (sampler, posterior) in trials.items():
        say(f"Geweke's test: {name}")
        steps = GEWEKE_STEPS[sampler] if posterior is None else PLANTED_STEPS
        result = geweke.compare(simulator, sampler, posterior, steps=steps)
        found[name] = {
            "as_it_should": result.passes == (posterior is None),
            "least_p": float(result.p.min()),
            "statistics": len(result.p),
            "mean_square_z": float((result.z**2).mean()),
            "acceptance": result.acceptance,
            "moved": result.moved,
            "worst": result.names[int(result.p.argmin())],
        }
        say(f"{name}: least p {result.p.min():.2g} of {len(result.p)}, acceptance {result.acceptance:.0%}")
    return found


def register_pairs(out: Path) -> dict[str, Any]:
    """The calibrated pairs, made on a finer mesh."""
    return pairs.register_pairs(out, same_mesh=False, say=say)


def register_on_one_mesh(out: Path) -> dict[str, Any]:
    """The same, made on the mesh that registers them."""
    return pairs.register_pairs(out, same_mesh=True, say=say)


def share_of_the_mesh(out: Path) -> dict[str, Any]:
    """λ/μ without images, on meshes other than the body's own."""
    return mesh_share.measure(out, say)


def register_external_pairs(out: Path) -> dict[str, Any]:
    """Pairs that no model of this project made; each takes some twenty minutes."""
    return external.register_pairs(out, say)


def carry(out: Path) -> dict[str, Any]:
    """Points and labels, by what `bayesreg apply` tells of them, on the mesh of the truth and where that is finer.

    What is written must not be surer than it may be, and labels not less sure either.
    """
    found = {}
    for name, finer in {"mesh of the truth": False, "finer truth": True}.items():
        say(f"points and labels: {name}")
        cases = carried.measure(finer, say=say)
        levels = np.array(carried.LEVELS)
        errors = 3 * np.sqrt(levels * (1 - levels) / len(cases))
        inside = (cases[:, None] <= levels[:, None]).mean(axis=0)
        names = [f"{way}, {part}" for way in ("there", "back") for part in carried.PARTS] + ["label"]
        written = inside[:, [0, len(carried.PARTS), -1]]
        found[name] = {
            "as_it_should": bool(
                (written > (levels - errors)[:, None]).all() and (inside[:, -1] < levels + errors).all()
            ),
            "cases": len(cases),
            "three binomial errors": errors.tolist(),
            "inside": {name: column.tolist() for name, column in zip(names, inside.T, strict=True)},
        }
        say(json.dumps(found[name]["inside"]))
    return found


PARTS = {
    "sbc": calibrate_by_simulation,
    "geweke": compare_simulators,
    "pairs": register_pairs,
    "same_mesh": register_on_one_mesh,
    "mesh_share": share_of_the_mesh,
    "external": register_external_pairs,
    "carried": carry,
}


def main() -> int:
    """All parts, or those asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=DEFAULT)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "calibration.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    for name in given.parts:
        found[name] = PARTS[name](given.out)
        path.write_text(json.dumps(found, indent=2) + "\n")
    wrong = [f"{part}: {name}" for part in given.parts for name, it in found[part].items() if not it["as_it_should"]]
    say("everything is calibrated" if not wrong else f"FAILED: {', '.join(wrong)}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
