"""Reader for JSON from strangers: it enforces limits, and names the fault of a refused file."""

from __future__ import annotations

import json
import math
import os
import stat
from collections import Counter
from pathlib import Path
from typing import Any

from clbench.base.errors import ClbenchError, InputError
from clbench.base.text import quoted

MOST_BYTES = 8 * 2**20
"""Size limit of a file. A record of Fetch-v1 has 0.07 MB; 8 MB of brackets take 0.3 GB of memory and 3 s."""

DEEPEST = 16
"""Nesting limit of lists and objects. Records have 5 levels."""

LONGEST_TEXT = 100_000
"""Length limit of a text in characters. Tracebacks are the longest texts."""

LONGEST_NAME = 200
"""Length limit of the name of an entry in characters."""

LARGEST = 2**64
"""Bound on whole numbers: their absolute value must be below it. Seeds have up to 64 bits."""

_SCALARS = {str, int, float, bool, type(None)}

OPEN_PLAINLY = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Flags for opening a file: do not follow a link, and do not wait for a pipe without a writer."""


class StrictJSONError(ClbenchError, ValueError):
    """A file is not JSON, or exceeds a limit."""


def refusal(error: Exception) -> OSError | None:
    """Return the file system's error if the file may be sound but cannot be read now, None otherwise.

    Args:
        error: Error of the file system, or an error that it caused, such as the one that `read_json` raises.
    """
    found = error if isinstance(error, OSError) else error.__cause__
    nothing = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
    return found if isinstance(found, OSError) and not isinstance(found, nothing) else None


def read_json(path: Path) -> Any:
    """Return the JSON in the regular file at `path`.

    Raises:
        StrictJSONError: The file is not regular, too large, not UTF-8 or not JSON; a name occurs twice in one
            object; or a value is nested too deep, too long, too large or not finite.
    """
    try:
        content = read_regular(path)
    except OSError as error:
        raise StrictJSONError(f"cannot be read ({error.strerror}).") from error
    try:
        value = json.loads(content.decode("utf-8"), parse_constant=_no_number, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        raise StrictJSONError(f"cannot be read as JSON ({error}).") from error
    check_json(value)
    return value


def read_regular(path: Path, most: int = MOST_BYTES) -> bytes:
    """Return the content of the regular file at `path`, which may have `most` bytes.

    Raises:
        StrictJSONError: The file is a link, not regular, or too large.
        OSError: The file system refuses to read it.
    """
    if path.is_symlink():
        raise StrictJSONError("is a symbolic link, which is not followed.")
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | OPEN_PLAINLY)) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise StrictJSONError("is not a regular file.")
        if status.st_size > most:
            raise StrictJSONError(f"has {status.st_size:,} bytes, more than {most:,}.")
        content = file.read(most + 1)
    if len(content) != status.st_size:
        raise StrictJSONError("changed its size while it was read.")
    return content


def _no_number(name: str) -> Any:
    """Refuse NaN and infinities, which Python reads although JSON does not have them."""
    raise InputError(f"{name} is not a JSON number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse a name that occurs twice: readers differ in which of the values they keep."""
    values = dict(pairs)
    if len(values) != len(pairs):
        ((name, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise InputError(f"the name {quoted(name)} is there twice in one object")
    return values


def check_json(value: Any, where: str = "it") -> None:
    """Refuse a value that is not JSON or exceeds a limit.

    Args:
        value: Value that `json` may have read.
        where: Name of the value in messages. Entries of an object have their own names.

    Raises:
        StrictJSONError: The value is refused.
    """
    if isinstance(value, dict):
        for name, entry in value.items():
            _check_name(where, name)
            _check(name, entry, 1)
    else:
        _check(where, value, 0)


def _check(where: str, value: Any, depth: int) -> None:
    kind = type(value)
    if kind in _SCALARS:
        _check_scalar(where, value)
        return
    if kind not in (list, dict):
        raise StrictJSONError(f"{where}: JSON has no type {kind.__name__}.")
    if depth == DEEPEST:
        raise StrictJSONError(f"{where}: nested more than {DEEPEST} deep.")
    if kind is dict:
        for name, entry in value.items():
            _check_name(where, name)
            _check(where, entry, depth + 1)
    # the columns of a record are long and have few different values
    elif (kinds := set(map(type, value))) <= _SCALARS:
        _check_range(where, value if kinds == {int} else [entry for entry in value if type(entry) is int])
        for entry in set(value):
            _check_scalar(where, entry)
    else:
        for entry in value:
            _check(where, entry, depth + 1)


def _check_range(where: str, numbers: list[int]) -> None:
    """Refuse numbers that are too large, before a set holds them.

    Multiples of 2**61 - 1 have one hash: a set of 100,000 of them takes minutes. Below `LARGEST`, 16 at most
    share a hash.
    """
    for one in (min(numbers), max(numbers)) if numbers else ():
        _check_scalar(where, one)


def _check_name(where: str, name: Any) -> None:
    if not isinstance(name, str):
        raise StrictJSONError(f"{where}: the name of an entry must be a string, not {name!r}.")
    if len(name) > LONGEST_NAME:
        raise StrictJSONError(
            f"{where}: a name of {len(name):,} characters: {quoted(name)}; at most {LONGEST_NAME} are "
            "allowed."
        )


def _check_scalar(where: str, value: Any) -> None:
    kind = type(value)
    if kind is float and not math.isfinite(value):
        raise StrictJSONError(f"{where}: a number that is not finite.")
    if kind is int and abs(value) >= LARGEST:
        raise StrictJSONError(
            f"{where}: a whole number of {value.bit_length()} bits; at most 64 are allowed."
        )
    if kind is str and len(value) > LONGEST_TEXT:
        raise StrictJSONError(
            f"{where}: a string of {len(value):,} characters; at most {LONGEST_TEXT:,} are allowed."
        )
