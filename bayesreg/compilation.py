"""Set the environment variables that control how JAX compiles programs, and where it stores the compiled programs."""

import os
import platform
import time
import zlib
from contextlib import suppress
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import platformdirs

# Compiled programs that are older than this number of days are removed. The programs for one mesh take about 5 MB.
MOST_DAYS = 30
# These flags halve the compilation time and do not slow the programs (docs/speed.md#compiling).
QUICK = "--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false"
# The flags are set only if the version of jaxlib starts with this text. XLA ends a process that uses an unknown flag,
# and new versions of XLA remove flags.
KNOWN_TO = "0.10."


def compile_quickly(flags: str = QUICK) -> None:
    """Reduce the compilation time of XLA, unless the variable XLA_FLAGS is set.

    The flags are set only for the versions of jaxlib with which they were measured, and only if no plugin of JAX for
    another device than the CPU is installed: for other devices one of the flags has another meaning.
    """
    if version("jaxlib").startswith(KNOWN_TO) and find_spec("jax_plugins") is None:
        os.environ.setdefault("XLA_FLAGS", flags)


def keep_compiled_programs() -> None:
    """Let JAX store compiled programs in the user's cache, unless the variable JAX_COMPILATION_CACHE_DIR is set.

    Each kind of processor has its own folder, because the computers of a cluster share home folders, and a program that
    was compiled for one kind of processor may not run on another kind. No program is stored if there is no writable
    home folder.
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
        # Another run may remove the same files at the same time.
        with suppress(FileNotFoundError):
            if program.stat().st_mtime < oldest:
                program.unlink()


def _processor() -> str:
    """Return a text that describes the kind of this machine's processor; it differs between kinds."""
    information = Path("/proc/cpuinfo")
    if not information.exists():
        return platform.processor() or platform.machine()
    lines = information.read_text(encoding="utf-8", errors="replace").splitlines()
    return "\n".join(
        sorted({line for line in lines if line.startswith(("model name", "CPU part", "flags", "Features"))})
    )
