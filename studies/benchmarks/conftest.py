"""The clock of the benchmarks, and the content of their JSON file."""

from __future__ import annotations

import os
import platform
import resource
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import pytest

STATISTICS = "median", "min", "iqr", "rounds"


@pytest.fixture
def timed(benchmark: Any) -> Callable[..., None]:
    """A function (function, *arguments, rounds=…, **facts) that times `function` after a warm-up round.

    It stores the facts, and the peak memory of the process so far.
    """

    def clock(function: Callable[..., Any], *arguments: Any, rounds: int, **facts: Any) -> None:
        benchmark.pedantic(
            lambda: jax.block_until_ready(function(*arguments)), rounds=rounds, warmup_rounds=1, iterations=1
        )
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        benchmark.extra_info.update(facts, process_peak_bytes=peak)

    return clock


@pytest.fixture(scope="module", autouse=True)
def few_memory_maps():
    """Free compiled programs: each maps memory, and Linux allows a process 65,530 maps."""
    yield
    jax.clear_caches()


@pytest.hookimpl(optionalhook=True)
def pytest_benchmark_update_json(output_json: dict[str, Any]) -> None:
    """Leave out the names of the machine, its user and its folders, and the times of single rounds."""
    machine, commit = output_json["machine_info"], output_json["commit_info"]
    report = {
        "datetime": output_json["datetime"],
        "machine_info": {
            "cpu": machine["cpu"].get("brand_raw", platform.machine()),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            **{name: version(name) for name in ("jax", "jaxlib", "numpy", "scipy", "cholespy")},
        },
        "commit_info": {name: commit.get(name) for name in ("id", "dirty")},
        "benchmarks": [
            {
                **{name: benchmark[name] for name in ("name", "param", "extra_info")},
                "stats": {name: benchmark["stats"][name] for name in STATISTICS},
            }
            for benchmark in output_json["benchmarks"]
        ],
    }
    output_json.clear()
    output_json.update(report)
