"""Read a cohort: a table of subjects, or patterns of their files, combined with a sweep of settings."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from itertools import product
from math import prod
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field, ValidationError

from bayesreg.config.errors import ConfigError, explain
from bayesreg.config.loading import read_mapping
from bayesreg.config.yaml_text import parse
from bayesreg.printable import find_unprintable
from bayesreg.settings import Count, Section

SUBJECT = "subject"
MOST_TASKS = 100_000
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,99}")
# Files that a batch writes beside the folders of its subjects.
RESERVED = ("cohort.csv", "cohort.parquet", "cohort.html")
# The last parts of those keys of a configuration that name files.
FILES = (
    "fixed", "moving", "labels", "intracranial", "fixed_ignore", "moving_ignore", "label_names", "t1", "file",
    "moving_file", "second_file", "field", "known_boundary", "landmarks", "moving_landmarks",
)  # fmt: skip
# Longer names of folders are cut here, and a digest is added.
LONGEST_NAME = 100


class ClusterConfig(Section):
    """The workers that share the runs of a cohort."""

    workers: Count = 1
    """The number of subjects that run at the same time. Each has its own process, with an equal share of the cores."""
    slurm: dict[str, Any] | None = None
    """Arguments of dask_jobqueue.SLURMCluster (queue, cores, memory, walltime …); the workers are then SLURM jobs."""


class CohortConfig(Section):
    """The content of a cohort's file."""

    config: Annotated[str, Field(strict=True, min_length=1)]
    """The configuration that all subjects share, a file beside this one."""
    subjects: str | dict[str, str]
    """A table (.csv, .tsv) beside this file, with a column subject and columns named after keys of the configuration,
    such as data.fixed (an empty cell leaves what all share); or a pattern for each of such keys, such as
    "bids/sub-{subject}/ses-pre/anat/*_T1w.nii.gz"."""
    sweep: dict[str, list[Any]] = Field(default_factory=dict)
    """Values of further keys; every subject runs with each combination of these values."""
    cluster: ClusterConfig = ClusterConfig()


class Task(NamedTuple):
    """One run of a cohort.

    Attributes
    ----------
    name : str
        The folder of the run, relative to the folder of the cohort.
    subject : str
    settings : dict
        The values of the sweep, by key.
    overrides : tuple of str
        Overrides of the configuration, as for `bayesreg.config.load_config`.
    """

    name: str
    subject: str
    settings: dict[str, Any]
    overrides: tuple[str, ...]


class Cohort(NamedTuple):
    """A cohort as read from its file: the shared configuration, the tasks, and the workers."""

    config: Path
    tasks: list[Task]
    cluster: ClusterConfig


def load_cohort(path: str | Path) -> Cohort:
    """Read the file of a cohort.

    Raises
    ------
    ConfigError
        If the file, its table or a pattern is wrong. Errors of a single subject appear when this subject is run.
    """
    path = Path(path).absolute()
    data = read_mapping(path)
    try:
        cohort = CohortConfig.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"the cohort {path} cannot be run:\n{explain(error, CohortConfig, data, {})}") from None
    config = path.parent / cohort.config
    if not config.is_file():
        raise ConfigError(f"the cohort {path}: config: there is no file {config}")
    rows = _of_patterns(cohort.subjects, path.parent) if isinstance(cohort.subjects, dict) else None
    rows = _of_table(path.parent / cohort.subjects) if isinstance(cohort.subjects, str) else rows
    assert rows is not None
    if not rows:
        raise ConfigError(f"the cohort {path} has no subject")
    if empty := [key for key, values in cohort.sweep.items() if not values]:
        raise ConfigError(f"the cohort {path}: sweep.{empty[0]} has no value")
    if (count := len(rows) * prod(map(len, cohort.sweep.values()))) > MOST_TASKS:
        raise ConfigError(f"the cohort {path} has {count:,} runs, more than the {MOST_TASKS:,} of one batch")
    tasks = [task for subject, row in rows.items() for task in _tasks(subject, row, cohort.sweep)]
    names: set[str] = set()
    for task in tasks:
        if task.name in names:
            raise ConfigError(f"the cohort {path}: two values of the sweep are one and the same: {task.name}")
        names.add(task.name)
    return Cohort(config, tasks, cohort.cluster)


def _of_table(path: Path) -> dict[str, dict[str, str]]:
    if path.suffix not in (".csv", ".tsv"):
        raise ConfigError(f"subjects: expected a table that ends in .csv or .tsv, got {path}")
    if not path.is_file():
        raise ConfigError(f"subjects: there is no table {path}")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [line for line in csv.reader(file, delimiter="\t" if path.suffix == ".tsv" else ",") if any(line)]
    except (csv.Error, UnicodeDecodeError) as error:
        raise ConfigError(f"subjects: {path} is no table: {error}") from None
    header = [name.strip() for name in lines[0]] if lines else []
    if twice := [name for name in header if header.count(name) > 1]:
        raise ConfigError(f"subjects: {path} has the column {twice[0]!r} twice")
    if SUBJECT not in header:
        raise ConfigError(f"subjects: {path} has no column {SUBJECT}; its columns are {', '.join(header) or 'none'}")
    rows: dict[str, dict[str, str]] = {}
    for number, line in enumerate(lines[1:], start=2):
        if len(line) != len(header):
            raise ConfigError(f"{path}, row {number}: {len(line)} cells under {len(header)} columns")
        if odd := [cell for cell in line if find_unprintable(cell)]:
            raise ConfigError(f"{path}, row {number}: a cell cannot be printed: {odd[0]!r:.80}")
        row = dict(zip(header, (cell.strip() for cell in line), strict=True))
        subject = row.pop(SUBJECT)
        if not _NAME.fullmatch(subject) or subject in RESERVED:
            raise ConfigError(
                f"{path}, row {number}: a subject is named by letters, digits, . _ -, up to 100 of them, and not as a "
                f"table of the batch; got {subject!r:.120}"
            )
        if subject in rows:
            raise ConfigError(f"{path}, row {number}: subject {subject} is there twice")
        cells = {key: cell for key, cell in row.items() if cell}
        rows[subject] = {key: _beside(path.parent, cell) if _names_file(key) else cell for key, cell in cells.items()}
    return rows


def _names_file(key: str) -> bool:
    return key.rpartition(".")[2] in FILES


def _beside(folder: Path, value: str) -> str:
    """Make a path relative to the table absolute if it exists; return any other value unchanged."""
    try:
        path = folder / value
        return str(path) if path.exists() else value
    except (OSError, ValueError):
        return value


def _of_patterns(patterns: Mapping[str, str], folder: Path) -> dict[str, dict[str, str]]:
    """Find the files of every subject that matches at least one of the patterns."""
    files: dict[str, dict[str, str]] = {}
    for key, pattern in patterns.items():
        if "{subject}" not in pattern:
            raise ConfigError(f"subjects: {key}: the pattern {pattern!r} does not hold {{subject}}")
        for subject, path in _matches(pattern, folder):
            if key in files.setdefault(subject, {}):
                raise ConfigError(f"subjects: {key}: {files[subject][key]} and {path} are both of subject {subject}")
            files[subject][key] = str(path)
    # A subject that lacks a file gets the path of the pattern: the run then reports this path as missing, and does not
    # use a file of the shared configuration.
    return {
        subject: {key: str(folder / pattern.replace("{subject}", subject)) for key, pattern in patterns.items()}
        | files[subject]
        for subject in sorted(files)
    }


def _matches(pattern: str, folder: Path) -> Iterator[tuple[str, Path]]:
    full_pattern = folder / Path(pattern).expanduser()
    root, pattern = Path(full_pattern.anchor), full_pattern.relative_to(full_pattern.anchor).as_posix()
    # The glob finds the paths; the regular expression extracts the subject from each path.
    regex = re.escape(pattern).replace(r"\*", "[^/]*").replace(r"\?", "[^/]")
    regex = regex.replace(re.escape("{subject}"), "(?P<subject>[A-Za-z0-9]+)", 1)
    expression = re.compile(regex.replace(re.escape("{subject}"), "(?P=subject)"))
    for path in sorted(root.glob(pattern.replace("{subject}", "*"))):
        match = expression.fullmatch(path.relative_to(root).as_posix())
        if match:
            yield match["subject"], path


def _tasks(subject: str, cells: Mapping[str, str], sweep: Mapping[str, list[Any]]) -> Iterator[Task]:
    for values in product(*sweep.values()):
        settings = dict(zip(sweep, values, strict=True))
        # JSON is valid YAML, so that a value of the sweep keeps its type. A cell of a table is read as YAML.
        values_of = {**{key: _quoted(cell) for key, cell in cells.items()},
                     **{key: json.dumps(value, default=str) for key, value in settings.items()}}  # fmt: skip
        overrides = tuple(f"{key}={value}" for key, value in values_of.items())
        name = f"{subject}/{_folder_of(settings)}" if settings else subject
        yield Task(name, subject, settings, overrides)


def _folder_of(settings: Mapping[str, Any]) -> str:
    """Make the name of a folder from settings; add a digest if characters had to be replaced or cut."""
    plain = "_".join(f"{key}-{value}" for key, value in settings.items())
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", plain)
    if name == plain and len(name) <= LONGEST_NAME:
        return name
    content = json.dumps(settings, default=str, sort_keys=True)
    return f"{name[:LONGEST_NAME]}-{hashlib.sha256(content.encode()).hexdigest()[:8]}"


def _quoted(cell: str) -> str:
    """Quote a cell if YAML might interpret a part of it; lists stay lists."""
    try:
        is_list = cell.startswith("[") and isinstance(parse(cell, "a cell")[0], list)
    except ConfigError:
        is_list = False
    return cell if is_list or re.fullmatch(r"[\w./+\-]+|~", cell) else "'" + cell.replace("'", "''") + "'"
