"""The command line: its statuses, what it says, and how fast help comes."""

import errno
import importlib
import inspect
import json
import logging
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from bayesreg import __version__
from bayesreg.cli import app
from bayesreg.types import InputError

QUICK = str(Path(__file__).parent.parent / "configs" / "quickstart.yaml")
# The module of `bayesreg.workflow` that holds each verb.
HOMES = {"run": "run", "check": "check", "simulate": "simulate", "report": "reports", "compare": "reports"}
PROGRAM = str(Path(sys.executable).parent / "bayesreg")


@pytest.fixture
def workflow(monkeypatch):
    """Verbs that keep what they were asked to do."""
    calls = {}

    def run(config, out, resume=False, progress=True):
        calls["run"] = (config, out, resume, progress)
        return SimpleNamespace(converged=config.seed == 1, folder=out)

    def check(config):
        calls["check"] = (config,)
        logging.getLogger("bayesreg.workflow.check").info("the images are alike")
        return SimpleNamespace(cost="about 3 minutes")

    def simulate(config, out):
        calls["simulate"] = (config, out)

    def report(folder):
        return folder / "report.html"

    def compare(folders, out):
        calls["compare"] = (folders, out)
        return out

    def replace(verb, function):
        monkeypatch.setattr(f"bayesreg.workflow.{HOMES[verb]}.{verb}", function)

    for function in (run, check, simulate, report, compare):
        replace(function.__name__, function)
    return SimpleNamespace(replace=replace, calls=calls)


def invoke(*arguments: str):
    return CliRunner().invoke(app, arguments)


def test_run_passes_overrides_and_flags_on_and_names_the_report(workflow):
    result = invoke(
        "run", QUICK, "-o", "out", "--set", "sampler.chains=7", "--set", "stop.max_steps=50", "--resume", "-q"
    )
    config, out, resume, progress = workflow.calls["run"]
    assert result.exit_code == 0
    assert (config.sampler.chains, config.stop.max_steps) == (7, 50)
    assert (out, resume, progress) == (Path("out"), True, False)
    assert f"Report: {Path('out') / 'report.html'}" in result.output


def test_run_that_did_not_converge_says_so_with_status_3(workflow):
    result = invoke("run", QUICK, "-o", "out", "--set", "seed=2")
    assert result.exit_code == 3
    assert "Not converged" in result.output
    assert "report.html" in result.output


def test_other_commands_call_their_verbs(workflow):
    assert invoke("check", QUICK, "--set", "seed=4").output == "the images are alike\nabout 3 minutes\n"
    assert workflow.calls["check"][0].seed == 4
    assert invoke("simulate", QUICK, "-o", "pair").exit_code == 0
    assert workflow.calls["simulate"][1] == Path("pair")
    assert str(Path("a") / "report.html") in invoke("report", "a").output
    assert invoke("compare", "a", "b", "c", "-o", "page.html").exit_code == 0
    assert workflow.calls["compare"] == ([Path("a"), Path("b"), Path("c")], Path("page.html"))


def test_the_real_verbs_take_what_the_commands_give():
    for name, arguments in {
        "run": ("config", "out", "resume", "progress"),
        "check": ("config",),
        "simulate": ("config", "out"),
        "report": ("folder",),
        "compare": ("folders", "out"),
    }.items():
        verb = getattr(importlib.import_module(f"bayesreg.workflow.{HOMES[name]}"), name)
        assert set(arguments) <= set(inspect.signature(verb).parameters)


def test_bad_input_is_one_message_with_status_2(workflow):
    def run(config, out, resume, progress):
        raise InputError(f"{out} holds another run; choose another folder, or go on with --resume")

    workflow.replace("run", run)
    result = invoke("run", QUICK, "-o", "out")
    assert result.exit_code == 2
    assert result.stderr == "bayesreg: out holds another run; choose another folder, or go on with --resume\n"


def test_a_full_disk_is_one_message_that_names_the_way_on(workflow):
    def run(config, out, resume, progress):
        raise OSError(errno.ENOSPC, "No space left on device", f"{out}/draws/block_00003.npz")

    workflow.replace("run", run)
    result = invoke("run", QUICK, "-o", "out")
    assert result.exit_code == 1
    assert "No space left on device: 'out/draws/block_00003.npz'" in result.stderr
    assert "--resume" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_bug_is_not_taken_for_bad_input(workflow):
    def check(config):
        raise ValueError("shapes do not match")

    workflow.replace("check", check)
    result = invoke("check", QUICK)
    assert result.exit_code == 1
    assert isinstance(result.exception, ValueError)


@pytest.mark.parametrize(
    "arguments", [["run", QUICK], ["compare", "one"], ["runn"], ["run", QUICK, "-o", "x", "--fast"]]
)
def test_wrong_usage_has_status_2(arguments):
    assert invoke(*arguments).exit_code == 2


def test_schema_is_json():
    assert json.loads(invoke("schema").output)["title"] == "Config"


@pytest.mark.parametrize("command", ["run", "check", "simulate"])
def test_program_shows_no_traceback_for_a_bad_configuration(tmp_path, command):
    path = tmp_path / "run.yaml"
    path.write_text("data: {source: mni152}\nsimulate: {kind: paper}\nsampler: {chans: 4}\n")
    out = [] if command == "check" else ["-o", str(tmp_path / "out")]
    done = subprocess.run([PROGRAM, command, str(path), *out], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "run.yaml:3: sampler.chans = 4: unknown key; did you mean chains?" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_version_is_the_packages():
    done = subprocess.run([PROGRAM, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"bayesreg {__version__}\n"


def test_programs_are_compiled_quickly(monkeypatch):
    calls = []
    monkeypatch.setattr("bayesreg.cli.compile_quickly", lambda: calls.append(True))
    assert CliRunner().invoke(app, ["schema"]).exit_code == 0
    assert calls == [True]


def test_help_loads_nothing_heavy_and_comes_at_once():
    code = (
        "import sys; from typer.testing import CliRunner; from bayesreg.cli import app;"
        "assert 'compare' in CliRunner().invoke(app, ['--help']).output;"
        "print(*{'jax', 'numpy', 'scipy', 'pydantic', 'matplotlib', 'arviz'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
    durations = []
    for _ in range(3):
        start = time.perf_counter()
        subprocess.run([PROGRAM, "--help"], capture_output=True, check=True)
        durations.append(time.perf_counter() - start)
    assert min(durations) < 1.5
