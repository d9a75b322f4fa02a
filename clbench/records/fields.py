"""Dataclasses from JSON, checked against the types of their fields."""

from __future__ import annotations

import dataclasses
import functools
import json
import types
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from clbench.base.entry_points import unknown
from clbench.base.errors import InputError
from clbench.base.text import quoted

_WORDS: dict[Any, str] = {
    str: "a string",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    list: "a list",
    dict: "an object with named entries",
    type(None): "null",
}


def load_fields(cls: type[Any], values: Any, what: str, inside: str = "") -> Any:
    """Return the dataclass `cls` with the fields in `values`.

    Every field must be present, no other field may be, and each value must have exactly the type that the
    class states: neither `true` nor 1.0 is a whole number.

    Args:
        cls: Dataclass. Its fields are texts, numbers, lists, dictionaries, dataclasses, literals and unions.
        values: Value that `json` read.
        what: Name of the object in messages, for example "run".
        inside: Prefix of the names of fields in messages, for example "run: ".

    Raises:
        InputError: A field is missing, unknown or of another type; the message names it.
    """
    _check_type(values, dict, what)
    hints = _hints(cls)  # type: ignore[arg-type]
    names = [field.name for field in dataclasses.fields(cls)]
    missing = [name for name in names if name not in values]
    if missing:
        raise InputError(f"{what}: {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing.")
    for name in values:
        if name not in names:
            raise InputError(str(unknown(f"field of {what}", name, names)))
    return cls(**{name: _load(hints[name], values[name], inside + name) for name in names})


@functools.cache
def _hints(cls: type[Any]) -> dict[str, Any]:
    # otherwise Python compiles each annotation anew: a sixth of the time to read a record
    return get_type_hints(cls)


def _load(hint: Any, value: Any, where: str) -> Any:
    """Return `value` as the type `hint`, a dataclass built from its fields; refuse other types."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if dataclasses.is_dataclass(hint):
        assert isinstance(hint, type)
        return load_fields(hint, value, where, f"{where}: ")
    if origin is Literal:
        if value not in arguments:
            text = quoted(value) if isinstance(value, str) else json.dumps(value)[:60]
            raise InputError(f"{where} must be {' or '.join(arguments)}, not {text}.")
        return value
    if origin in (Union, types.UnionType):
        return _load_union(arguments, value, where)
    _check_type(value, origin or hint, where)
    # the entries of long tables are checked by columns, see `clbench.records.reader`
    if origin is list:
        return [_load(arguments[0], entry, f"an entry of {where}") for entry in value]
    return value


def _load_union(members: tuple[Any, ...], value: Any, where: str) -> Any:
    for member in members:
        if _fits(value, _kind(member)):
            return _load(member, value, where)
    words = " or ".join(_WORDS[_kind(member)] for member in members)
    raise InputError(f"{where} must be {words}, not {json.dumps(value)[:60]}.")


def _kind(hint: Any) -> Any:
    """Return the type of the JSON that stands for `hint`, a dictionary for a dataclass."""
    return dict if dataclasses.is_dataclass(hint) else get_origin(hint) or hint


def _check_type(value: Any, kind: Any, where: str) -> None:
    if not _fits(value, kind):
        raise InputError(f"{where} must be {_WORDS[kind]}, not {json.dumps(value)[:60]}.")


def _fits(value: Any, kind: Any) -> bool:
    # not isinstance: True would pass for a whole number
    return type(value) is kind or (kind is float and type(value) is int)
