"""`make calibrate`: simulation-based calibration and Geweke's test, with figures and a JSON file.

python -m studies.calibration -o DIR [--parts sbc geweke surfaces pairs same_mesh mesh_share external carried]

The program ends with status 1 if an experiment fails.
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
from studies.calibration import carried, external, figures, geweke, mesh_share, pairs, sbc, surfaces
from studies.calibration.simulator import T_SIMILARITY, VARIANTS, Simulator, Variant, calibrated, treated_as_it_says

# Errors on purpose, which the tests must detect: T_s fixed at 1.5 times its true value, the elastic prior without its
# normaliser.
PLANTED: dict[str, dict[str, Any]] = {
    "T_s 1.5 times too high": {"t_similarity": 1.5 * T_SIMILARITY},
    "not normalised": {"normalised": False},
}
# The number of steps of each kernel moves its chains by about one standard deviation. The chains of a wrong kernel
# drift from their start as long as they run.
GEWEKE_STEPS = {"rwmh": 60, "hmc": 10, "nuts": 10}
PLANTED_STEPS = 40
# The reference Gaussian is wider than the posterior of random loads: more and shorter steps.
LOADS = {"step_size": 0.1, "steps": 20}

# The other experiments take up to an hour each; --parts names them.
DEFAULT = ["sbc", "geweke"]

# Each compiles programs of its own, a minute.
SURFACES = 40

BEGAN = time.perf_counter()


def report_progress(text: str) -> None:
    """Print a message after the minutes since the start."""
    print(f"{(time.perf_counter() - BEGAN) / 60:5.1f} min  {text}", flush=True)


def calibrate_by_simulation(out: Path) -> dict[str, Any]:
    """Test the ranks and the coverage of every variant, and of the planted errors."""
    runs: dict[str, sbc.Ranks] = {}
    for name, variant in VARIANTS.items():
        report_progress(f"calibration: {name}")
        with treated_as_it_says(variant):
            runs[name] = sbc.calibrate(Simulator(variant), report_progress=report_progress)
    for name, options in PLANTED.items():
        report_progress(f"calibration, planted error: {name}")
        variant = VARIANTS["no skull"]
        posterior, settings = calibrated(variant, **options), sbc.Settings(replications=100)
        runs[name] = sbc.calibrate(Simulator(variant), posterior, settings, report_progress=report_progress)
    summaries = {}
    for name, ranks in runs.items():
        figures.rank_histograms(ranks, out / f"ranks_{name.replace(' ', '_')}.png")
        summaries[name] = _summary(ranks, planted=name in PLANTED)
        report_progress(f"{name}: {summaries[name]['verdict']}; least p {summaries[name]['least_p']:.2g}")
    figures.coverage(runs, out / "coverage.png")
    return summaries


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


def calibrate_surfaces(out: Path) -> dict[str, Any]:
    """Test the ranks and the coverage of `gibbs` with a surface."""
    ranks = surfaces.calibrate(SURFACES, report_progress)
    figures.rank_histograms(ranks, out / "ranks_surface.png")
    summary = _summary(ranks, planted=False)
    report_progress(f"surface: {summary['verdict']}; least p {summary['least_p']:.2g}")
    return {"surface": summary}


def compare_simulators(out: Path) -> dict[str, Any]:
    """Run Geweke's test of each kernel with the skull, of `hmc` with a surrogate, and of a planted error."""
    skull, loads = VARIANTS["skull"], VARIANTS["loads with surrogate"]
    trials: dict[str, tuple[str, Variant, br.Posterior | None]] = {name: (name, skull, None) for name in GEWEKE_STEPS}
    trials["hmc, loads with surrogate"] = ("hmc", loads, None)
    wrong = calibrated(skull, **PLANTED["T_s 1.5 times too high"])
    trials["hmc, T_s 1.5 times too high"] = ("hmc", skull, wrong)
    summaries = {}
    for name, (sampler, variant, posterior) in trials.items():
        report_progress(f"Geweke's test: {name}")
        steps = GEWEKE_STEPS[sampler] if posterior is None else PLANTED_STEPS
        options = LOADS if variant.loads else {"steps": steps}
        with treated_as_it_says(variant):
            result = geweke.compare(Simulator(variant), sampler, posterior, **options)
        summaries[name] = {
            "as_it_should": result.passes == (posterior is None),
            "least_p": float(result.p.min()),
            "statistics": len(result.p),
            "mean_square_z": float((result.z**2).mean()),
            "acceptance": result.acceptance,
            "moved": result.moved,
            "worst": result.names[int(result.p.argmin())],
        }
        report_progress(f"{name}: least p {result.p.min():.2g} of {len(result.p)}, acceptance {result.acceptance:.0%}")
    return summaries


def register_pairs(out: Path) -> dict[str, Any]:
    """Register the calibrated pairs, which are made on a finer mesh."""
    return pairs.register_pairs(out, same_mesh=False, report_progress=report_progress)


def register_on_one_mesh(out: Path) -> dict[str, Any]:
    """Register the calibrated pairs on the mesh that made them."""
    return pairs.register_pairs(out, same_mesh=True, report_progress=report_progress)


def share_of_the_mesh(out: Path) -> dict[str, Any]:
    """Fit λ/μ without images, on the mesh of the body and on other meshes."""
    return mesh_share.measure(out, report_progress)


def register_external_pairs(out: Path) -> dict[str, Any]:
    """Register pairs that no model of this project made; each takes about twenty minutes."""
    return external.register_pairs(out, report_progress)


def carry(out: Path) -> dict[str, Any]:
    """Test the uncertainty of points and labels from `bayesreg apply`, on the mesh of the truth and on a coarser one.

    Coverage of points must not be too low; coverage of labels must not be too low or too high.
    """
    summaries = {}
    for name, finer in {"mesh of the truth": False, "finer truth": True}.items():
        report_progress(f"points and labels: {name}")
        cases = carried.measure(finer, report_progress=report_progress)
        levels = np.array(carried.LEVELS)
        errors = 3 * np.sqrt(levels * (1 - levels) / len(cases))
        inside = (cases[:, None] <= levels[:, None]).mean(axis=0)
        names = [f"{way}, {source}" for way in ("there", "back") for source in carried.COVARIANCES] + ["label"]
        written = inside[:, [0, len(carried.COVARIANCES), -1]]
        summaries[name] = {
            "as_it_should": bool(
                (written > (levels - errors)[:, None]).all() and (inside[:, -1] < levels + errors).all()
            ),
            "cases": len(cases),
            "three binomial errors": errors.tolist(),
            "inside": {name: column.tolist() for name, column in zip(names, inside.T, strict=True)},
        }
        report_progress(json.dumps(summaries[name]["inside"]))
    return summaries


EXPERIMENTS = {
    "sbc": calibrate_by_simulation,
    "geweke": compare_simulators,
    "surfaces": calibrate_surfaces,
    "pairs": register_pairs,
    "same_mesh": register_on_one_mesh,
    "mesh_share": share_of_the_mesh,
    "external": register_external_pairs,
    "carried": carry,
}


def main() -> int:
    """Run the experiments that --parts names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--parts", nargs="+", choices=EXPERIMENTS, default=DEFAULT)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "calibration.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    for name in arguments.parts:
        results[name] = EXPERIMENTS[name](arguments.out)
        path.write_text(json.dumps(results, indent=2) + "\n")
    wrong = [
        f"{experiment}: {name}"
        for experiment in arguments.parts
        for name, result in results[experiment].items()
        if not result["as_it_should"]
    ]
    report_progress("everything is calibrated" if not wrong else f"FAILED: {', '.join(wrong)}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
