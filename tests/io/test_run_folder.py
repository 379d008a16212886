"""What stands in a run folder is whole, or told to be damaged, whoever dies or writes in between."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bayesreg.io.run_folder import PARTIAL, STATUS, RunFolder, Status
from bayesreg.types import InputError


def write(folder, stage=None, **contents):
    """Write files; None stands for a failure."""
    with RunFolder(folder).writing(stage) as place:
        for name, content in contents.items():
            if content is None:
                raise ZeroDivisionError
            place(f"{name}.txt").write_text(content)


def read(folder, name):
    return RunFolder(folder).file(f"{name}.txt").read_text()


def test_files_appear_together_or_not_at_all(tmp_path):
    out = tmp_path / "new" / "run"
    write(out, "prepared", one="1", two="2")
    with pytest.raises(ZeroDivisionError):
        write(out, "finished", **{"one": "other", "deep/three": "3", "four": None})
    assert (read(out, "one"), read(out, "two")) == ("1", "2")
    assert not RunFolder(out).is_listed("deep/three.txt")
    assert RunFolder(out).stage == "prepared"
    assert not list(out.rglob(".partial*"))


@pytest.mark.parametrize("replaced", [0, 1, 2, 3])
def test_killed_between_two_replacements_each_file_is_whole(tmp_path, monkeypatch, replaced):
    """Also where it happens again, and again, and other contents come then."""
    write(tmp_path, "prepared", one="1", two="2", three="3")
    replace = Path.replace
    for attempt in ("a", "b"):
        count = 0

        def killed(path, target):
            nonlocal count
            if Path(target).suffix == ".txt":
                if count == replaced:
                    raise KeyboardInterrupt
                count += 1
            return replace(path, target)

        monkeypatch.setattr(Path, "replace", killed)
        if replaced == 3:
            write(tmp_path, "finished", one=f"1{attempt}", two=f"2{attempt}", three=f"3{attempt}")
        else:
            with pytest.raises(KeyboardInterrupt):
                write(tmp_path, "finished", one=f"1{attempt}", two=f"2{attempt}", three=f"3{attempt}")
        monkeypatch.undo()
        contents = [read(tmp_path, name) for name in ("one", "two", "three")]
        assert contents == [f"{k}{attempt if k <= replaced else ''}" for k in (1, 2, 3)]
        assert RunFolder(tmp_path).stage == ("finished" if replaced == 3 else "prepared")


def test_damage_and_loss_are_named(tmp_path):
    write(tmp_path, "finished", one="1", two="2")
    (tmp_path / "one.txt").write_text("I")
    with pytest.raises(InputError, match=r"one\.txt is damaged, or was changed"):
        read(tmp_path, "one")
    with pytest.raises(InputError, match=r"one\.txt is damaged"):
        RunFolder(tmp_path).require_unchanged(but="two.txt")
    RunFolder(tmp_path).require_unchanged(but="one.txt")
    (tmp_path / "two.txt").unlink()
    with pytest.raises(InputError, match=r"holds no whole run: two\.txt is missing"):
        read(tmp_path, "two")
    (tmp_path / "stray.txt").write_text("mine")
    with pytest.raises(InputError, match=r"stray\.txt is missing"):
        read(tmp_path, "stray")


@pytest.mark.parametrize("spoil", ["", "{}", "[1]", "{", '{"stage": "finished", "files": {}, "digest": "0"}', "stage"])
def test_a_damaged_status_is_not_believed(tmp_path, spoil):
    write(tmp_path, "prepared", one="1")
    path = tmp_path / STATUS
    if spoil == "stage":
        spoil = json.dumps(json.loads(path.read_text()) | {"stage": "finished"})
    path.write_text(spoil)
    with pytest.raises(InputError, match=r"status\.json is damaged"):
        read(tmp_path, "one")
    path.unlink()
    with pytest.raises(InputError, match=r"holds no run of bayesreg"):
        read(tmp_path, "one")


def test_what_never_stood_is_forgotten(tmp_path):
    """A run that was killed before its inputs stood begins again, with other ones."""
    with pytest.raises(ZeroDivisionError):
        write(tmp_path, "prepared", one="1", two=None)
    assert RunFolder(tmp_path).status() is None
    write(tmp_path, None, one="1")
    assert RunFolder(tmp_path).stage is None
    write(tmp_path, "prepared", two="2")
    assert list(RunFolder(tmp_path).status().files) == ["two.txt"]


def test_blocks_are_dropped_from_the_list_before_the_disk(tmp_path):
    with RunFolder(tmp_path).writing("prepared") as place:
        place("draws/0.txt").write_text("0")
        place("one.txt").write_text("1")
    RunFolder(tmp_path).drop("draws")
    assert list(RunFolder(tmp_path).status().files) == ["one.txt"]
    assert not list((tmp_path / "draws").iterdir())


HOLD = """
import sys, time
from pathlib import Path
from bayesreg.io.run_folder import RunFolder
with RunFolder(Path(sys.argv[1])).locked():
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_folder_is_one_process_s_until_that_is_dead(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        (tmp_path / ".partial-1-fixed.nii.gz").touch()
        with pytest.raises(InputError, match="another process is working in"), RunFolder(tmp_path).locked():
            pass
        assert (tmp_path / ".partial-1-fixed.nii.gz").exists()
    finally:
        holder.kill()
        holder.communicate()
    with RunFolder(tmp_path).locked(), RunFolder(tmp_path).locked():
        assert not list(tmp_path.glob(".partial*"))


@pytest.mark.parametrize("name", ["../outside.txt", "bids/../../outside.txt", "/tmp/outside.txt"])
def test_a_list_does_not_lead_out_of_its_folder(tmp_path, name):
    """A folder from a stranger: what it lists beyond itself is neither read nor removed."""
    out, outside = tmp_path / "run", tmp_path / "outside.txt"
    outside.write_text("mine")
    write(out, "finished", one="1")
    status = Status("finished", {**RunFolder(out).status().files, name: ("0" * 64,)})
    RunFolder(out)._write(status)
    for act in (lambda: RunFolder(out).drop("bids"), lambda: RunFolder(out).file(name)):
        with pytest.raises(InputError, match="damaged"):
            act()
    assert outside.read_text() == "mine"


def test_a_link_does_not_lead_out_of_its_folder(tmp_path):
    out, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "mine.txt").write_text("mine")
    write(out, "finished", **{"one": "1", "bids/mine": "mine"})
    (out / "bids" / "mine.txt").unlink()
    (out / "bids").rmdir()
    (out / "bids").symlink_to(elsewhere)
    for act in (
        lambda: RunFolder(out).drop("bids"),
        lambda: RunFolder(out).file("bids/mine.txt"),
        lambda: write(out, **{"bids/mine": "other"}),
    ):
        with pytest.raises(InputError, match="leads out of its folder by a link"):
            act()
    assert (elsewhere / "mine.txt").read_text() == "mine"


def test_what_another_run_within_is_writing_stays(tmp_path):
    """As of a folder of runs, which is taken for a run by mistake."""
    inner = tmp_path / "subject"
    stale = tmp_path / f"{PARTIAL}7-one.txt"
    with RunFolder(inner).locked(), RunFolder(inner).writing("prepared") as place:
        place("one.txt").write_text("1")
        stale.write_text("0")
        with RunFolder(tmp_path).locked():
            assert not stale.exists()
    assert read(inner, "one") == "1"


@pytest.mark.parametrize("content", [None, "[" * 200_000])
def test_a_status_that_is_none_is_told(tmp_path, content):
    path = tmp_path / "status.json"
    path.mkdir() if content is None else path.write_text(content)
    with pytest.raises(InputError, match="damaged"):
        RunFolder(tmp_path).status()


def test_a_link_that_leads_nowhere_is_told(tmp_path):
    for name in ("round", "gone"):
        (tmp_path / name).symlink_to(tmp_path / ("round" if name == "round" else "nothing"))
        assert RunFolder(tmp_path / name).status() is None
        with pytest.raises(InputError, match="is a link that leads nowhere"):
            RunFolder(tmp_path / name).require_fresh()


def test_a_run_within_a_run_is_refused(tmp_path):
    write(tmp_path / "run", "finished", one="1")
    with pytest.raises(InputError, match="lies in that of another run"):
        RunFolder(tmp_path / "run" / "again").require_fresh()
    # A file of this name that another program wrote is no run.
    (tmp_path / "status.json").write_text("{}")
    RunFolder(tmp_path / "other").require_fresh()


def test_a_file_in_place_of_a_folder_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    assert RunFolder(tmp_path / "file").status() is None
    with pytest.raises(InputError, match="nothing can be written"), RunFolder(tmp_path / "file").locked():
        pass


def test_fresh_folders_are_accepted(tmp_path):
    RunFolder(tmp_path / "not there yet").require_fresh()
    RunFolder(tmp_path).require_fresh()
    (tmp_path / "notes.txt").write_text("mine")
    RunFolder(tmp_path).require_fresh()
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("name", ["run.json", "config.yaml", "draws/block_00000.npz", "posterior.nc"])
def test_a_folder_that_holds_another_run_is_refused(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    with pytest.raises(ValueError, match=r"already holds a run .*--resume"):
        RunFolder(tmp_path).require_fresh()


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(ValueError, match="is a file"):
        RunFolder(tmp_path / "out").require_fresh()
