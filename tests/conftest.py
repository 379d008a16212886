"""Shapes and types are checked while the tests run, and compiled programs are kept from one run to the next."""

import os
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

from bayesreg.compilation import QUICK, compile_quickly

_ROOT = Path(__file__).parent.parent

# Before anything imports JAX; `setdefault`, so that a caller may choose otherwise.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_ROOT / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("MPLBACKEND", "agg")
# Half of what a test takes is compiling: programs need not be fast, and two workers keep both cores busy as it is.
compile_quickly(f"{QUICK.replace('level=1', 'level=0')} --xla_cpu_parallel_codegen_split_count=1")

# Not for settings and the configuration: pydantic checks them already, with protocols that beartype cannot look at.
_MODULES = [f"bayesreg.{path.stem}" for path in (_ROOT / "bayesreg").iterdir() if path.stem[0] not in "_."]
install_import_hook(
    [name for name in _MODULES if name not in ("bayesreg.config", "bayesreg.settings")], "beartype.beartype"
)


# Every compiled program maps memory; past the 65,530 maps that Linux allows a process the next one crashes it.
_MOST_MAPS = 30_000


@pytest.fixture(scope="module", autouse=True)
def few_memory_maps():
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > _MOST_MAPS:
        import jax

        jax.clear_caches()
