"""Translate pydantic's errors into messages for users: the place, the value, and the expected value."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from bayesreg.model.observations.registry import kinds
from bayesreg.model.observations.section import ObservationSection
from bayesreg.types import InputError

Keys = tuple[str | int, ...]

# Further errors are counted but not described.
MOST_ERRORS = 100

_KEYS, _NUMBER, _WHOLE, _LIST, _TRUTH = "keys with values", "a number", "a whole number", "a list", "true or false"
_EXPECTED = {
    "bool_type": _TRUTH,
    "bool_parsing": _TRUTH,
    "float_type": _NUMBER,
    "float_parsing": _NUMBER,
    "int_type": _WHOLE,
    "int_parsing": _WHOLE,
    "int_from_float": _WHOLE,
    "string_type": "text",
    "list_type": _LIST,
    "tuple_type": _LIST,
    "dict_type": _KEYS,
    "model_type": _KEYS,
    "model_attributes_type": _KEYS,
}


class ConfigError(InputError):
    """A configuration that cannot be run; the message lists all its errors."""


def explain(error: ValidationError, model: type[BaseModel], data: dict[str, Any], origins: dict[Keys, str]) -> str:
    """Describe all errors, one per line.

    Parameters
    ----------
    error : ValidationError
    model : type
        The pydantic model that `data` should fit.
    data : dict
        The validated data.
    origins : dict
        The file and line of each key ("run.yaml:3"), by the key's path.
    """
    errors = error.errors(include_url=False)
    entries = [(_path(details, data, model), details) for details in errors[:MOST_ERRORS]]
    messages: dict[Keys, list[str]] = {}
    for path, details in entries:
        if not any(_explains(*entry, path, details["type"]) for entry in entries):
            messages.setdefault(path, []).append(_message(details, model))
    lines = [f"  {_head(path, data, origins)}: {_join(texts)}" for path, texts in messages.items()]
    more = len({details["loc"] for details in errors}) - MOST_ERRORS
    return "\n".join([*lines, *([f"  and {more:,} more"] if more > 0 else [])])


def _explains(other_path: Keys, by: ErrorDetails, path: Keys, kind: str) -> bool:
    """Decide whether the error `by` at the path `other_path` makes an error of type `kind` at `path` superfluous.

    Every member of a union reports its own errors. If a value is wrong as a whole, its parts are right, and errors of
    its parts are dropped. If a part of a value is wrong, the value was meant to have parts, and errors of the whole are
    dropped.
    """
    if len(other_path) < len(path):
        return path[: len(other_path)] == other_path and by["type"] in ("value_error", "wrong")
    return len(other_path) > len(path) > 0 and other_path[: len(path)] == path and kind in (*_EXPECTED, "literal_error")


def _join(messages: list[str]) -> str:
    first, *others = dict.fromkeys(messages)
    return " or ".join((first, *(message.removeprefix("expected ") for message in others)))


def _path(details: ErrorDetails, data: Any, model: type[BaseModel]) -> Keys:
    """Return pydantic's location without the names of union members, which no user has written."""
    *parents, last = details["loc"] or ("",)
    path: Keys = ()
    for key in (*parents, last):
        try:
            data, path = data[key], (*path, key)
        except (KeyError, IndexError, TypeError):
            path = path or (key,)  # An omitted section may have errors, too.
    left_out = details["type"] == "missing" or last in _fields_at(tuple(parents), model)
    if left_out and path[-1] != last:
        path = (*path, last)
    return (*path, *_custom_key(details))


def _custom_key(details: ErrorDetails) -> Keys:
    key = details.get("ctx", {}).get("key" if details["type"] == "wrong" else "discriminator")
    return tuple(key.strip("'").split(".")) if key else ()


def _head(path: Keys, data: Any, origins: dict[Keys, str]) -> str:
    """Write the origin, the dotted path and, if it is short, the value."""
    present, value = 0, data
    while present < len(path) and isinstance(value, dict | list):
        try:
            value = value[path[present]]  # type: ignore[index]
        except (KeyError, IndexError):
            break
        present += 1
    origin = next((origins[path[:n]] for n in range(present, 0, -1) if path[:n] in origins), None)
    shown = json.dumps(value, default=str, ensure_ascii=False)
    name = ".".join(map(str, path)) or "the whole"
    value_text = f" = {shown}" if present == len(path) and len(shown) <= 60 else ""
    return f"{origin}: {name}{value_text}" if origin else name + value_text


def _message(details: ErrorDetails, model: type[BaseModel]) -> str:
    *parents, key = details["loc"] or ("",)
    kind, context = details["type"], details.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown(str(key), _fields_at(tuple(parents), model))
    if kind == "missing":
        field = _fields_at(tuple(parents), model).get(str(key))
        return f"missing; expected: {field.description}" if field and field.description else "missing"
    if kind == "union_tag_not_found":
        return "missing"
    if kind == "union_tag_invalid":
        return f"expected one of {context['expected_tags']}"
    text = details["msg"].removeprefix("Value error, ")
    if kind in _EXPECTED:
        return f"expected {_EXPECTED[kind]}"
    return text.replace("Input should be a valid", "expected a").replace("Input should be", "expected")


def _unknown(key: str, fields: dict[str, FieldInfo]) -> str:
    if key in fields:
        return "this kind has no such key"
    close = difflib.get_close_matches(key, fields, n=1)
    return f"unknown key; did you mean {close[0]}?" if close else f"unknown key; known are {', '.join(fields)}"


def _fields_at(location: Keys, model: type[BaseModel]) -> dict[str, FieldInfo]:
    """Return the fields of the model at a location; for a union, the fields of all its members."""
    models = [model]
    for key in location:
        inner = [m for parent in models if key in parent.model_fields for m in _models(parent.model_fields[str(key)])]
        models = inner or [m for m in models if key in _tags(m)] or models
    return {name: field for m in models for name, field in m.model_fields.items()}


def _models(field: FieldInfo) -> list[type[BaseModel]]:
    models = [m for m in _leaves(field.annotation) if isinstance(m, type) and issubclass(m, BaseModel)]
    return [m for model in models for m in (kinds().values() if model is ObservationSection else (model,))]


def _tags(model: type[BaseModel]) -> set[object]:
    """List the names that pydantic may give to a member of a union: its class, or a value of its discriminator."""
    return {model.__name__, *(leaf for field in model.model_fields.values() for leaf in _leaves(field.annotation))}


def _leaves(annotation: object) -> Iterator[object]:
    arguments = get_args(annotation)
    if not arguments:
        yield annotation
    for argument in arguments:
        yield from _leaves(argument)
