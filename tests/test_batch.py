"""Cohorts: what is read of their files, and what becomes of sound and of broken subjects."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from distributed import LocalCluster
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg.config.cohort import load_cohort
from bayesreg.io.run_folder import digest_of
from bayesreg.workflow.batch import batch, share_of_devices
from studies.endurance.damage import quick_reports
from studies.endurance.small_run import write_pair


@pytest.fixture
def write(tmp_path):
    """A function that writes the file of a cohort, whose configuration is there."""
    (tmp_path / "run.yaml").write_text("data: {source: mni152}\n")

    def cohort(**content):
        YAML(typ="safe").dump({"config": "run.yaml", **content}, tmp_path / "cohort.yaml")
        return tmp_path / "cohort.yaml"

    return cohort


def test_a_table_times_a_sweep(write, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "t1.nii.gz").touch()
    rows = "subject\tdata.fixed\tmodel.preset\nanna\ta/t1.nii.gz\tpaper\nbea\ta/t1.nii.gz\t\n"
    (tmp_path / "table.tsv").write_text(rows)
    cohort = load_cohort(write(subjects="table.tsv", sweep={"seed": [1, 2], "sampler.name": ["hmc"]}))
    assert cohort.config == tmp_path / "run.yaml"
    assert [task.name for task in cohort.tasks] == [
        f"{subject}/sampler.name-hmc_seed-{seed}" for subject in ("anna", "bea") for seed in (1, 2)
    ]
    fixed = f"data.fixed={tmp_path / 'a' / 't1.nii.gz'}"
    assert cohort.tasks[0].overrides == (fixed, "model.preset=paper", 'sampler.name="hmc"', "seed=1")
    assert cohort.tasks[3].overrides == (fixed, 'sampler.name="hmc"', "seed=2")
    assert cohort.tasks[3].settings == {"seed": 2, "sampler.name": "hmc"}


def test_patterns_of_bids(write, tmp_path):
    for subject in ("01", "02"):
        for session in ("pre", "post"):
            folder = tmp_path / "bids" / f"sub-{subject}" / f"ses-{session}" / "anat"
            folder.mkdir(parents=True)
            if (subject, session) != ("02", "post"):
                (folder / f"sub-{subject}_ses-{session}_acq-x_T1w.nii.gz").touch()
    patterns = {
        f"data.{name}": f"bids/sub-{{subject}}/ses-{session}/anat/sub-{{subject}}_*_T1w.nii.gz"
        for name, session in (("fixed", "pre"), ("moving", "post"))
    }
    first, second = load_cohort(write(subjects=patterns)).tasks
    assert (first.name, second.name) == ("01", "02")
    assert [text.partition("=")[0] for text in first.overrides] == ["data.fixed", "data.moving"]
    # What is missing shows when the subject is run: nothing is taken of the configuration that all share.
    with pytest.raises(br.InputError, match=r"sub-02/ses-post/anat/sub-02_\*_T1w.nii.gz.*: no such file"):
        br.load_config(tmp_path / "run.yaml", [*second.overrides, "data.source=files"])
    # The same by absolute patterns.
    absolute_patterns = {key: f"{tmp_path}/{pattern}" for key, pattern in patterns.items()}
    assert load_cohort(write(subjects=absolute_patterns)).tasks == [first, second]


def test_cells_are_read_as_what_they_are(write, tmp_path):
    """A number is no file, even where one has its name; lists are lists; an empty cell leaves what all share."""
    (tmp_path / "1").mkdir()
    (tmp_path / "b b.nii.gz").touch()
    header = "\ufeffsubject, seed,data.fixed,data.moving,data.label_table.wm,description\n"
    (tmp_path / "table.csv").write_text(f'{header}a,1,1,b b.nii.gz,"[3, 4]",[x: y\nb,2,,,,\n')
    first, second = load_cohort(write(subjects="table.csv")).tasks
    assert first.overrides == (
        "seed=1",
        f"data.fixed={tmp_path / '1'}",
        f"data.moving='{tmp_path / 'b b.nii.gz'}'",
        "data.label_table.wm=[3, 4]",
        "description='[x: y'",
    )
    assert second.overrides == ("seed=2",)


def test_values_that_are_alike_have_folders_of_their_own(write, tmp_path):
    (tmp_path / "one.csv").write_text("subject\na\n")
    values = ["a b.nii.gz", "a-b.nii.gz", [0.4, 0.6], "x" * 300]
    names = [task.name for task in load_cohort(write(subjects="one.csv", sweep={"data.moving": values})).tasks]
    assert len(set(names)) == 4
    assert names[1] == "a/data.moving-a-b.nii.gz"
    assert max(map(len, names)) < 120
    assert names == [task.name for task in load_cohort(tmp_path / "cohort.yaml").tasks]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"subjects": "none.csv"}, "there is no table"),
        ({"subjects": "run.yaml"}, "ends in .csv or .tsv"),
        ({"subjects": "odd.csv"}, "no column subject"),
        ({"subjects": "twice.csv"}, "row 3: subject a is there twice"),
        ({"subjects": "path.csv"}, "a subject is named by letters"),
        ({"subjects": "empty.csv"}, "has no subject"),
        ({"subjects": {"data.fixed": "t1.nii.gz"}}, "does not hold {subject}"),
        ({"subjects": "twice.csv", "sweeps": {}}, "did you mean sweep"),
        ({"subjects": "twice.csv", "config": "other.yaml"}, "there is no file"),
        ({"subjects": "one.csv", "sweep": {"seed": [1, "1"]}}, "two values of the sweep are one and the same"),
        ({"subjects": "one.csv", "sweep": {"seed": []}}, "sweep.seed has no value"),
        ({"subjects": "ragged.csv"}, "row 3: 3 cells under 2 columns"),
        ({"subjects": "header.csv"}, "has the column 'seed' twice"),
        ({"subjects": "reserved.csv"}, "and not as a table of the batch"),
        ({"subjects": "long.csv"}, "up to 100 of them"),
        ({"subjects": "control.csv"}, "cannot be printed"),
        ({"subjects": "one.csv", "sweep": {f"k{n}": list(range(100)) for n in range(3)}}, "more than the 100,000"),
    ],
)
def test_what_is_refused(write, tmp_path, content, message):
    files = {"odd": "name\na\n", "twice": "subject\na\na\n", "path": "subject\n../a\n", "empty": "subject\n",
             "one": "subject\na\n", "ragged": "subject,seed\na,1\nb,2,3\n", "header": "subject,seed, seed\na,1,2\n",
             "reserved": "subject\ncohort.csv\n", "long": f"subject\n{'a' * 300}\n",
             "control": "subject,description\na,\x1b[2J\n"}  # fmt: skip
    for name, text in files.items():
        (tmp_path / f"{name}.csv").write_text(text)
    with pytest.raises(br.InputError, match=message):
        load_cohort(write(**content))


def test_without_a_scheduler(write, tmp_path, monkeypatch):
    monkeypatch.setattr("bayesreg.workflow.batch.PATIENCE", "1s")
    (tmp_path / "one.csv").write_text("subject\na\n")
    with pytest.raises(br.InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        batch(write(subjects="one.csv"), tmp_path / "out", scheduler="tcp://127.0.0.1:9", progress=False)


def test_sound_subjects_finish_and_broken_ones_are_named(tmp_path):
    """Workers of a scheduler that exists; what has ended is not run twice."""
    write_pair(tmp_path, steps=40)
    # To the terminal's markup this name would close what was never opened.
    rows = "subject,seed,data.fixed\nsound,4,\nbroken,5,[/x]none.nii.gz\n"
    (tmp_path / "table.csv").write_text(rows)
    YAML(typ="safe").dump({"config": "run.yaml", "subjects": "table.csv"}, tmp_path / "cohort.yaml")
    with quick_reports(), LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        address = cluster.scheduler.address
        table = batch(tmp_path / "cohort.yaml", tmp_path / "out", address, progress=False)
        ended = digest_of(tmp_path / "out" / "sound" / "posterior.nc")
        again = batch(tmp_path / "cohort.yaml", tmp_path / "out", address, progress=False)
    assert table["state"].tolist() == again["state"].tolist() == ["finished", "failed"]
    assert "none.nii.gz" in table["message"][1]
    assert "no such file" in table["message"][1]
    assert digest_of(tmp_path / "out" / "sound" / "posterior.nc") == ended
    result = br.load_result(tmp_path / "out" / "sound")
    assert result.run.manifest["seed"] == 4
    assert table["shift_max_mm"][0] == pytest.approx(np.linalg.norm(result.u_mean, axis=1).max())
    posterior = result.idata.posterior["mu"].sel(tissue="wm")
    assert table["mu_wm"][0] == pytest.approx(float(posterior.median()))
    assert table["mu_wm_low"][0] <= table["mu_wm"][0] <= table["mu_wm_high"][0]
    for read, name in ((pd.read_csv, "cohort.csv"), (pd.read_parquet, "cohort.parquet")):
        assert read(tmp_path / "out" / name)["folder"].tolist() == ["sound", "broken"]
    page = (tmp_path / "out" / "cohort.html").read_text(encoding="utf-8")
    assert "1 of 2 runs have finished" in page
    assert 'href="sound/report.html"' in page


def test_workers_share_the_devices():
    """Each sees one; where there are more workers, they share its memory."""
    assert share_of_devices(1, 3, ()) == {}
    environments = [share_of_devices(number, 3, ("0", "GPU-5")) for number in range(3)]
    assert [environment["CUDA_VISIBLE_DEVICES"] for environment in environments] == ["0", "GPU-5", "0"]
    assert {environment["XLA_PYTHON_CLIENT_MEM_FRACTION"] for environment in environments} == {"0.375"}
    assert share_of_devices(1, 2, ("0", "1"))["XLA_PYTHON_CLIENT_MEM_FRACTION"] == "0.750"
