"""Read configurations from YAML files, and write them back."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.nodes import MappingNode, Node, SequenceNode
from ruamel.yaml.representer import RoundTripRepresenter

from bayesreg.config.configuration import Config, complete
from bayesreg.config.errors import ConfigError, Keys, explain
from bayesreg.config.yaml_text import DEEPEST, parse
from bayesreg.model.observations.registry import kinds
from bayesreg.model.options import ModelConfig
from bayesreg.settings import search_folders

# If one of these keys changes, a section replaces the section that it extends, because the two have different keys.
_KINDS = ("source", "kind", "name")


@dataclass(frozen=True)
class _Document:
    """The content of YAML files, the file and line of each key, and the folders of the files."""

    data: dict[str, Any]
    origins: dict[Keys, str]
    folders: tuple[Path, ...]


def load_config(path: str | Path, overrides: Sequence[str] = ()) -> Config:
    """Read, complete and check a configuration.

    Parameters
    ----------
    path : path
        A YAML 1.2 file. ``extends: other.yaml`` includes another file in the same folder: sections are merged key by
        key, and the value of a key replaces the whole value in the other file.
    overrides : sequence of str
        ``"sampler.chains=4"``: a dotted path and a YAML value, applied last.

    Returns
    -------
    Config
        The configuration with absolute paths. Relative paths are searched beside the file, in the current folder and in
        the folder of the environment variable BAYESREG_DATA.

    Raises
    ------
    ConfigError
        If the configuration is wrong. The message names the place, the value and the expected value of every error.
    """
    return _validated(_override(_read(Path(path), ()), overrides), f"the configuration {path}")


def load_stored_config(path: str | Path) -> Config:
    """Read a configuration that `resolved_yaml` wrote into a run folder; the files that it names may be missing."""
    return _validated(_read(Path(path), ()), f"the configuration {path}", stored=True)


def make_config(sections: Mapping[str, Any], overrides: Sequence[str] = ()) -> Config:
    """Complete and check a configuration that is given as a mapping.

    Parameters
    ----------
    sections : mapping
        The content that a file would have.
    overrides : sequence of str
        As in `load_config`.

    Raises
    ------
    ConfigError
        As `load_config`.
    """
    return _validated(_override(_Document(dict(sections), {}, ()), overrides), "what was asked for")


def read_mapping(path: str | Path) -> dict[str, Any]:
    """Read the keys and values of a YAML file; ConfigError if it has none."""
    return _read(Path(path), ()).data


def _validated(document: _Document, title: str, *, stored: bool = False) -> Config:
    try:
        context = {"folders": search_folders(*document.folders), "stored": stored}
        return Config.model_validate(document.data, context=context)
    except ValidationError as error:
        reasons = explain(error, Config, document.data, document.origins)
        raise ConfigError(f"{title} cannot be run:\n{reasons}") from None


def resolved_yaml(config: Config) -> str:
    """Write a configuration as YAML with all defaults; `load_config` and `load_stored_config` read it back."""
    yaml, text = YAML(), io.StringIO()
    yaml.Representer = _Representer
    yaml.width = 120
    yaml.dump(config.model_dump(mode="json"), text)
    return text.getvalue()


def model_of(text: str) -> ModelConfig:
    """Read the section model of a configuration that `resolved_yaml` wrote; the files that it names may be missing."""
    return ModelConfig.model_validate(parse(text, "config.yaml")[0]["model"])


def schema() -> dict[str, Any]:
    """Make the JSON schema of a configuration file, for editors."""
    result = Config.model_json_schema()
    any_kind: Any = reduce(or_, kinds().values())
    observed = TypeAdapter(any_kind).json_schema()
    result["$defs"] |= observed.pop("$defs")
    result["properties"]["observations"]["items"] = observed
    result["properties"]["extends"] = {"type": "string", "description": "A file that this one takes over."}
    return result


class _Representer(RoundTripRepresenter):
    """YAML representer that writes None as null; the base class writes nothing."""


_Representer.add_representer(
    type(None), lambda representer, _: representer.represent_scalar("tag:yaml.org,2002:null", "null")
)


def _read(path: Path, extending_files: tuple[Path, ...]) -> _Document:
    path = path.absolute()
    if path in extending_files:
        raise ConfigError(f"{path} extends itself, by way of {extending_files[-1]}")
    if len(extending_files) > DEEPEST:
        raise ConfigError(
            f"{extending_files[0]} extends a file that extends another, and so on, over more than {DEEPEST} files"
        )
    data, node = parse(_text(path), str(path))
    data = {} if data is None else data
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected keys with values, such as 'seed: 1'; got {data!r:.60}")
    origins = {keys: f"{path.name}:{line}" for keys, line in _lines(node)} if node else {}
    document = _Document(data, origins, (path.parent,))
    base = data.pop("extends", None)
    if base is None:
        return document
    if not isinstance(base, str):
        raise ConfigError(f"{origins['extends',]}: extends = {base!r}: expected the path of a file")
    return _merge(_read(path.parent / base, (*extending_files, path)), document)


def _text(path: Path) -> str:
    if not path.is_file():
        reason = "is a folder" if path.is_dir() else "does not exist"
        raise ConfigError(f"the configuration {path} {reason}; expected a YAML file")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not UTF-8 text ({error.reason} at byte {error.start})") from None
    except PermissionError:
        raise ConfigError(f"the configuration {path} may not be read; see its permissions") from None


def _lines(node: Node, path: Keys = ()) -> Iterator[tuple[Keys, int]]:
    """Yield the path and the line number of every entry under a node."""
    if isinstance(node, MappingNode):
        children = [(key.value, key, value) for key, value in node.value]
    elif isinstance(node, SequenceNode):
        children = [(index, value, value) for index, value in enumerate(node.value)]
    else:
        children = []
    for key, first_node, value in children:
        yield (*path, key), first_node.start_mark.line + 1
        yield from _lines(value, (*path, key))


def _merge(base: _Document, top: _Document) -> _Document:
    data = dict(base.data)
    for key, section in top.data.items():
        below = data.get(key)
        if isinstance(section, dict) and isinstance(below, dict):
            changed = any(k in section and section[k] != below.get(k) for k in _KINDS)
            section = section if changed else {**below, **section}
        data[key] = section
    return _Document(data, base.origins | top.origins, (*top.folders, *base.folders))


def _override(document: _Document, overrides: Sequence[str]) -> _Document:
    # The defaults are filled in first: an override may then name the first observation of a file that lists none.
    data, origins = complete(document.data) if overrides else document.data, dict(document.origins)
    for text in overrides:
        path, equals, value = text.partition("=")
        keys = tuple(path.strip().split("."))
        if not equals or not all(keys):
            raise ConfigError(f"--set {text:.200}: expected a dotted path and a value, such as sampler.chains=4")
        if len(keys) > DEEPEST:
            raise ConfigError(f"--set {text:.200}: a path of more than {DEEPEST} keys")
        data = _with_value(data, keys, parse(value, f"--set {text}")[0], text)
        origins[tuple(int(key) if key.isdecimal() else key for key in keys)] = f"--set {text}"
    return _Document(data, origins, document.folders)


def _with_value(data: Any, keys: Sequence[str], value: Any, text: str) -> Any:
    first, *rest = keys
    if data is None:
        data = {}
    if isinstance(data, list):
        if not (first.isdecimal() and int(first) < len(data)):
            raise ConfigError(f"--set {text}: {first} is no entry of a list of {len(data)}; they are numbered from 0")
        changed = _with_value(data[int(first)], rest, value, text) if rest else value
        return [changed if index == int(first) else entry for index, entry in enumerate(data)]
    if not isinstance(data, dict):
        raise ConfigError(f"--set {text}: {first} would lie under {data!r:.60}, which has no keys")
    return {**data, first: _with_value(data.get(first), rest, value, text) if rest else value}
