"""The tables beside peers: which pairs, what is kept, how it is printed."""

import argparse
import json
import os
import sys

import pytest

from studies.external import __main__ as table

SCORES = {
    "error": [0.234, 0.561, 5.22],
    "gm": [0.21, 0.5, 5.0],
    "wm": [0.27, 0.6, 4.0],
    "csf": [0.24, 0.6, 5.2],
    "unregistered_mean": 2.261,
    "folded_share": 0.0012,
    "given_share": 0.987,
}
OURS = SCORES | {"coverage_50_90_95": [0.51, 0.9, 0.949], "sd_over_rms_error": 1.02}
PAIR = table.PairRequest("sag", 11, 0.15)


def test_pairs_are_named():
    assert table.PairRequest.read("sag:11:0.15") == PAIR
    assert PAIR.name == "sag-11-0.15"
    assert [pair.name for pair in table.DEFAULT] == [
        "sag-11-0", "sag-12-0.15", "sag-13-0.25", "gravity-11-0", "gravity-12-0.15", "gravity-13-0.25",
    ]  # fmt: skip
    with pytest.raises(argparse.ArgumentTypeError, match="none of sag, gravity, resect"):
        table.PairRequest.read("twist:1:0")
    with pytest.raises(argparse.ArgumentTypeError, match="no KIND:SEED:BIAS"):
        table.PairRequest.read("sag:1")


def test_tables():
    rows = [
        table.Row(PAIR, "bayesreg", OURS, {"seconds": 1200.0, "processor_seconds": None}, False),
        table.Row(PAIR, "Demons", SCORES, {"seconds": 90.0, "processor_seconds": 150.0}, None),
    ]
    named = "sag, seed 11, bias 0.15: 2.26 mm"
    errors = "0.234 | 0.561 | 5.220 | 0.21 | 0.27 | 0.24 | 0.12%"
    assert table.accuracy(rows).splitlines()[2:] == [
        f"| {named} | bayesreg | {errors} | 20.0 |  |",
        f"| {named} | Demons | {errors} | 1.5 | 2.5 |",
    ]
    assert table.uncertainty(rows).splitlines()[2:] == ["| sag, seed 11 | 51.0% / 90.0% / 94.9% | 1.02 | 98.7% | no |"]
    assert table.uncertainty(rows[1:]) == ""


def test_scores_are_kept_until_the_field_is_newer(tmp_path, monkeypatch):
    field, facts, record = (tmp_path / name for name in ("u.nii.gz", "pair.json", "scores/Demons.json"))
    field.touch()
    facts.touch()
    calls = []
    monkeypatch.setattr(table, "score", lambda *arguments: calls.append(arguments) or {"times": len(calls)})
    assert [table.scored(record, tmp_path, field)["times"] for _ in range(2)] == [1, 1]
    later = record.stat().st_mtime + 10
    os.utime(field, (later, later))
    assert table.scored(record, tmp_path, field)["times"] == 2


def test_programs_are_timed_and_their_failures_told(tmp_path):
    record = tmp_path / "times" / "peer.json"
    table.timed([sys.executable, "-c", "raise SystemExit(3)"], record, table.WRITTEN)
    assert json.loads(record.read_text())["seconds"] > 0
    with pytest.raises(SystemExit, match="status 1"):
        table.timed([sys.executable, "-c", "raise SystemExit(1)"], record)


def test_bayesreg_takes_the_configuration(tmp_path):
    from bayesreg.config import load_config

    for name in ("fixed", "moving", "labels", "intracranial"):
        (tmp_path / "pair").mkdir(exist_ok=True)
        (tmp_path / "pair" / f"{name}.nii.gz").touch()
    config = load_config(table.configure(tmp_path / "pair"))
    assert config.model.elastic_prior.kind == "loads"
    assert config.data.tissues == ("csf", "gm", "wm")
