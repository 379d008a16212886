"""How JAX compiles programs and where it keeps them, said by variables that it reads when it starts."""

import os
import platform
import time
import zlib
from contextlib import suppress
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import platformdirs

# For so long are compiled programs kept, some 5 MB of them for a mesh.
MOST_DAYS = 30
# Half the time for compiling, and programs that are no slower (docs/speed.md#compiling).
QUICK = "--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false"
# XLA ends a process that names a flag which it does not know, and drops flags as it goes.
KNOWN_TO = "0.10."


def compile_quickly(flags: str = QUICK) -> None:
    """Have XLA spend less on compiling, unless its own variable is set.

    Only with the version of jaxlib that this was measured with, and where JAX has no devices but the processor: for
    others one of the flags means something else.
    """
    if version("jaxlib").startswith(KNOWN_TO) and find_spec("jax_plugins") is None:
        os.environ.setdefault("XLA_FLAGS", flags)


def keep_compiled_programs() -> None:
    """Have JAX keep compiled programs in the user's cache for later runs, unless its own variable names a folder.

    Each kind of processor has a folder of its own there: homes are shared on clusters, and what is compiled for one
    kind may not run on another. Where there is no home, or none that can be written to, nothing is kept.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        kind = f"{zlib.crc32(_processor().encode()):08x}"
        folder = platformdirs.user_cache_path("bayesreg") / "programs" / kind
        folder.mkdir(parents=True, exist_ok=True)
        _remove_old(folder)
    except (OSError, RuntimeError):
        return
    if folder.is_absolute() and os.access(folder, os.W_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def _remove_old(folder: Path) -> None:
    oldest = time.time() - MOST_DAYS * 24 * 3600
    for program in folder.iterdir():
        # Another run may be doing the same.
        with suppress(FileNotFoundError):
            if program.stat().st_mtime < oldest:
                program.unlink()


def _processor() -> str:
    """A text that tells kinds of processors apart."""
    information = Path("/proc/cpuinfo")
    if not information.exists():
        return platform.processor() or platform.machine()
    lines = information.read_text(encoding="utf-8", errors="replace").splitlines()
    return "\n".join(
        sorted({line for line in lines if line.startswith(("model name", "CPU part", "flags", "Features"))})
    )
