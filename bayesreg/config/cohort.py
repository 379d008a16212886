"""A cohort: a table of subjects, or patterns of their files, times a sweep of settings."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from itertools import product
from math import prod
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import pandas as pd
from pydantic import Field, ValidationError

from bayesreg.config.errors import ConfigError, explain
from bayesreg.config.loading import read_mapping
from bayesreg.config.values import Count, Section

SUBJECT = "subject"
MOST_TASKS = 100_000
_NAME = re.compile(r"[A-Za-z0-9._-]+")


class ClusterConfig(Section):
    """The workers that share the runs among them."""

    workers: Count = 1
    """How many subjects at a time, each in a process of its own, which a fair share of the cores is for."""
    slurm: dict[str, Any] | None = None
    """What dask_jobqueue.SLURMCluster is given (queue, cores, memory, walltime …): workers are then jobs of SLURM."""


class CohortConfig(Section):
    """The content of a cohort's file."""

    config: Annotated[str, Field(strict=True, min_length=1)]
    """The configuration that all subjects share, a file beside this one."""
    subjects: str | dict[str, str]
    """A table (.csv, .tsv) beside this file, with a column subject and columns named after keys of the configuration,
    such as data.fixed; or a pattern for each of such keys, such as "bids/sub-{subject}/ses-pre/anat/*_T1w.nii.gz"."""
    sweep: dict[str, list[Any]] = Field(default_factory=dict)
    """Values of further keys; every subject is run with each combination of them."""
    cluster: ClusterConfig = ClusterConfig()


class Task(NamedTuple):
    """One run of a cohort.

    Attributes
    ----------
    name : str
        Its folder, relative to that of the cohort.
    subject : str
    settings : dict
        Of the sweep.
    overrides : tuple of str
        Of the configuration, as `bayesreg.config.load_config` takes them.
    """

    name: str
    subject: str
    settings: dict[str, Any]
    overrides: tuple[str, ...]


class Cohort(NamedTuple):
    """A cohort as it was read: the configuration that all share, the tasks, and who does the work."""

    config: Path
    tasks: list[Task]
    cluster: ClusterConfig


def load_cohort(path: str | Path) -> Cohort:
    """Read the file of a cohort.

    Raises
    ------
    ConfigError
        If the file, its table or a pattern is wrong. What is wrong with one subject alone shows when it is run.
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
    if (count := len(rows) * prod(map(len, cohort.sweep.values()))) > MOST_TASKS:
        raise ConfigError(f"the cohort {path} has {count:,} runs, more than the {MOST_TASKS:,} of one batch")
    tasks = [task for subject, given in rows.items() for task in _tasks(subject, given, cohort.sweep)]
    return Cohort(config, tasks, cohort.cluster)


def _of_table(path: Path) -> dict[str, dict[str, str]]:
    if path.suffix not in (".csv", ".tsv"):
        raise ConfigError(f"subjects: expected a table that ends in .csv or .tsv, got {path}")
    if not path.is_file():
        raise ConfigError(f"subjects: there is no table {path}")
    try:
        table = pd.read_csv(path, sep="\t" if path.suffix == ".tsv" else ",", dtype=str, keep_default_na=False)
    except (ValueError, UnicodeDecodeError) as error:
        raise ConfigError(f"subjects: {path} is no table: {str(error).splitlines()[0]}") from None
    if SUBJECT not in table:
        raise ConfigError(f"subjects: {path} has no column {SUBJECT}; its columns are {', '.join(table.columns)}")
    found: dict[str, dict[str, str]] = {}
    for number, row in enumerate(table.to_dict("records"), start=2):
        subject = str(row.pop(SUBJECT)).strip()
        if not _NAME.fullmatch(subject) or subject.startswith("."):
            raise ConfigError(f"{path}, line {number}: a subject is named by letters, digits, . _ -, got {subject!r}")
        if subject in found:
            raise ConfigError(f"{path}, line {number}: subject {subject} is there twice")
        cells = {str(key): str(value).strip() for key, value in row.items()}
        found[subject] = {key: _beside(path.parent, value) for key, value in cells.items() if value}
    return found


def _beside(folder: Path, value: str) -> str:
    """A path relative to the table as an absolute one; anything else as it is."""
    try:
        place = folder / value
        return str(place) if place.exists() else value
    except (OSError, ValueError):
        return value


def _of_patterns(patterns: Mapping[str, str], folder: Path) -> dict[str, dict[str, str]]:
    """Subjects for which all patterns name one file each."""
    found: dict[str, dict[str, str]] = {}
    for key, pattern in patterns.items():
        if "{subject}" not in pattern:
            raise ConfigError(f"subjects: {key}: the pattern {pattern!r} does not hold {{subject}}")
        for subject, path in _matches(pattern, folder):
            if key in found.setdefault(subject, {}):
                raise ConfigError(f"subjects: {key}: {found[subject][key]} and {path} are both of subject {subject}")
            found[subject][key] = str(path)
    return {subject: found[subject] for subject in sorted(found)}


def _matches(pattern: str, folder: Path) -> Iterator[tuple[str, Path]]:
    # As a glob, and as an expression that tells which part of a path is the subject.
    own = re.escape(pattern).replace(r"\*", "[^/]*").replace(r"\?", "[^/]")
    own = own.replace(re.escape("{subject}"), "(?P<subject>[A-Za-z0-9]+)", 1)
    expression = re.compile(own.replace(re.escape("{subject}"), "(?P=subject)"))
    for path in sorted(folder.glob(pattern.replace("{subject}", "*"))):
        match = expression.fullmatch(path.relative_to(folder).as_posix())
        if match:
            yield match["subject"], path


def _tasks(subject: str, given: Mapping[str, str], sweep: Mapping[str, list[Any]]) -> Iterator[Task]:
    for values in product(*sweep.values()):
        settings = dict(zip(sweep, values, strict=True))
        parts = [re.sub(r"[^A-Za-z0-9._-]+", "-", f"{key}-{value}") for key, value in settings.items()]
        # JSON is YAML: a value of the sweep comes back as what it was. A cell of a table is read as YAML.
        values_of = {**{key: _quoted(cell) for key, cell in given.items()},
                     **{key: json.dumps(value, default=str) for key, value in settings.items()}}  # fmt: skip
        overrides = tuple(f"{key}={value}" for key, value in values_of.items())
        yield Task("/".join([subject, *(["_".join(parts)] if parts else [])]), subject, settings, overrides)


def _quoted(cell: str) -> str:
    """A cell in quotes, where YAML would take a part of it for something else."""
    return cell if re.fullmatch(r"[\w./+\-]+", cell) else "'" + cell.replace("'", "''") + "'"
