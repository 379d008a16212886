"""Where compiled programs are kept, and how they are compiled."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bayesreg import compilation


def test_compiled_programs_are_kept_in_the_users_cache_unless_a_folder_is_named(tmp_path):
    # A program that takes next to no time to compile is kept, too: a run has a hundred of them.
    code = (
        "from bayesreg.compilation import keep_compiled_programs; keep_compiled_programs();"
        "import jax, jax.numpy as jnp; jax.block_until_ready(jax.jit(lambda x: 2 * x)(jnp.ones(3)));"
        "print(jax.config.jax_compilation_cache_dir)"
    )

    def named(**variables: str) -> str:
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
        environment = {**inherited, **variables}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
        return done.stdout.strip()

    home, own_folder, blocked = tmp_path / "home", tmp_path / "own", tmp_path / "a_file"
    folder = named(XDG_CACHE_HOME=str(home))
    assert folder.startswith(str(home / "bayesreg"))
    programs = sorted(path.name for path in Path(folder).glob("*-cache"))
    assert programs
    assert named(XDG_CACHE_HOME=str(home)) == folder
    assert sorted(path.name for path in Path(folder).glob("*-cache")) == programs
    assert named(XDG_CACHE_HOME=str(home), JAX_COMPILATION_CACHE_DIR=str(own_folder)) == str(own_folder)
    blocked.touch()
    assert named(XDG_CACHE_HOME=str(blocked)) == "None"


def test_without_a_home_nothing_is_kept_and_old_programs_go(tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setattr(compilation.platformdirs, "user_cache_path", lambda name: tmp_path / name)
    # Set, so that it is put back afterwards.
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    compilation.keep_compiled_programs()
    folder = Path(os.environ.pop("JAX_COMPILATION_CACHE_DIR"))
    assert folder.is_relative_to(tmp_path / "bayesreg")
    old, new = folder / "old-cache", folder / "new-cache"
    old.touch()
    new.touch()
    os.utime(old, (0, time.time() - 40 * 24 * 3600))
    # Another run removed it in between: it is listed no longer there.
    (folder / "gone-cache").symlink_to(folder / "nowhere")
    compilation.keep_compiled_programs()
    assert sorted(path.name for path in folder.iterdir()) == ["gone-cache", "new-cache"]
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(folder)
    del os.environ["JAX_COMPILATION_CACHE_DIR"]

    def homeless(name):
        raise RuntimeError("could not determine the home directory")

    monkeypatch.setattr(compilation.platformdirs, "user_cache_path", homeless)
    compilation.keep_compiled_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_a_run_begins_without_what_judges_and_draws_its_results():
    code = "import sys, bayesreg.workflow.run; print(*({'arviz', 'matplotlib', 'nilearn'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


@pytest.mark.parametrize(
    ("jaxlib", "plugins", "flags", "expected"),
    [
        (f"{compilation.KNOWN_TO}9", None, None, compilation.QUICK),
        (f"{compilation.KNOWN_TO}9", None, "--xla_own=1", "--xla_own=1"),
        ("99.0.0", None, None, None),
        (f"{compilation.KNOWN_TO}9", "a plugin", None, None),
    ],
)
def test_flags_are_set_only_where_they_are_known(monkeypatch, jaxlib, plugins, flags, expected):
    monkeypatch.setenv("XLA_FLAGS", flags or "")
    if flags is None:
        monkeypatch.delenv("XLA_FLAGS")
    monkeypatch.setattr(compilation, "version", lambda _: jaxlib)
    monkeypatch.setattr(compilation, "find_spec", lambda _: plugins)
    compilation.compile_quickly()
    assert os.environ.get("XLA_FLAGS") == expected
