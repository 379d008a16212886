"""What the benchmarks share: the clock, and what of its findings goes to the JSON file."""

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
    """(function, *arguments, rounds=…, **told): times it, after a round that does not count; what is told is kept.

    Kept, too, is the greatest memory that the process has taken so far.
    """

    def clock(function: Callable[..., Any], *arguments: Any, rounds: int, **told: Any) -> None:
        benchmark.pedantic(
            lambda: jax.block_until_ready(function(*arguments)), rounds=rounds, warmup_rounds=1, iterations=1
        )
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        benchmark.extra_info.update(told, process_peak_bytes=peak)

    return clock


@pytest.fixture(scope="module", autouse=True)
def few_memory_maps():
    """Every compiled program maps memory, of which Linux allows a process 65,530 parts."""
    yield
    jax.clear_caches()


@pytest.hookimpl(optionalhook=True)
def pytest_benchmark_update_json(output_json: dict[str, Any]) -> None:
    """Leave out what names a machine, its user or its folders, and every single time."""
    machine, commit = output_json["machine_info"], output_json["commit_info"]
    kept = {
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
                **{name: found[name] for name in ("name", "param", "extra_info")},
                "stats": {name: found["stats"][name] for name in STATISTICS},
            }
            for found in output_json["benchmarks"]
        ],
    }
    output_json.clear()
    output_json.update(kept)
