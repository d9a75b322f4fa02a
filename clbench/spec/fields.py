"""Checks of values, most of them dataclass fields: a wrong value is reported where it is written."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from clbench.base.entry_points import is_entry_point
from clbench.base.errors import InputError, WrongTypeError
from clbench.base.text import quoted

LONGEST = 100
"""Length limit of a name, in characters."""


def is_whole(value: Any) -> bool:
    """Return whether a value is a whole number of Python or NumPy; True and 1.0 are not."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def whole_number(name: str, value: int, least: int) -> int:
    """Return a whole number of Python or NumPy as a Python int, which JSON can hold.

    Raises:
        InputError: The value is not a whole number, or is below `least`.
    """
    if not is_whole(value) or value < least:
        raise InputError(f"{name} must be a whole number from {least}, not {value!r}.")
    return int(value)


def check_whole(part: object, least: int, *fields: str, most: int | None = None) -> None:
    """Check that fields of `part` are whole numbers from `least` to `most`; None sets no upper bound.

    A number of NumPy becomes a Python int, which JSON can hold.

    Raises:
        WrongTypeError: A field is not a whole number.
        InputError: A field is too small or too large.
    """
    for name in fields:
        value = getattr(part, name)
        if not is_whole(value):
            raise WrongTypeError(f"{_place(part, name)} must be a whole number, not {value!r}.")
        if value < least:
            raise InputError(f"{_place(part, name)} must be at least {least}, not {value}.")
        if most is not None and value > most:
            raise InputError(f"{_place(part, name)} must be at most {most}, not {value}.")
        object.__setattr__(part, name, int(value))  # the part may be a frozen dataclass


def check_positive(part: object, *fields: str) -> None:
    """Check that fields of `part` are finite numbers above 0.

    Raises:
        WrongTypeError: A field is not a number.
        InputError: A field is not above 0, or not finite.
    """
    for name in fields:
        check_number(part, name)
        value = getattr(part, name)
        if not 0 < value < math.inf:
            wanted = "finite" if value == math.inf else "above 0"
            raise InputError(f"{_place(part, name)} must be {wanted}, not {value}.")


def check_share(part: object, *fields: str) -> None:
    """Check that fields of `part` are numbers from 0 to 1.

    Raises:
        WrongTypeError: A field is not a number.
        InputError: A field is outside of this range.
    """
    for name in fields:
        check_number(part, name)
        if not 0 <= getattr(part, name) <= 1:
            raise InputError(f"{_place(part, name)} must be from 0 to 1, not {getattr(part, name)}.")


def check_tuple(part: object, kind: type, *fields: str) -> None:
    """Check that fields of `part` are tuples whose entries are all of the type `kind`.

    Raises:
        WrongTypeError: A field is not a tuple, or has an entry of another type.
    """
    entry = "string" if kind is str else kind.__name__
    for name in fields:
        value = getattr(part, name)
        if isinstance(value, tuple) and all(isinstance(one, kind) for one in value):
            continue
        found = f"one {entry}" if isinstance(value, kind) else quoted(repr(value))
        raise WrongTypeError(
            f"{_place(part, name)} must be a tuple of {entry}s, not {found}; write a tuple with one entry as "
            "(entry,)."
        )


def check_entry_point(part: object, *fields: str) -> None:
    """Check that fields of `part` are texts of the form "module:attribute".

    Raises:
        WrongTypeError: A field is not a text but, for example, the object itself.
        InputError: A text has another form.
    """
    for name in fields:
        value = getattr(part, name)
        if not isinstance(value, str):
            own = f"{getattr(value, '__module__', 'module')}:{getattr(value, '__qualname__', 'name')}"
            raise WrongTypeError(
                f"{_place(part, name)} must be a string 'module:name' such as {own!r}, not {value!r}: "
                "other processes import it by its name."
            )
        if not is_entry_point(value):
            raise InputError(f"{_place(part, name)} must have the form 'module:name', not {value!r}.")


def check_number(part: object, name: str) -> None:
    """Check that a field of `part` is a number.

    Raises:
        WrongTypeError: The field is not a number.
    """
    value = getattr(part, name)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise WrongTypeError(f"{_place(part, name)} must be a number, not {value!r}.")


def _place(part: object, name: str) -> str:
    """Return the name of a field for a message, with the name of its owner if it has one."""
    owner = getattr(part, "name", None) or getattr(part, "id", None)
    return f"{name} of {owner}" if owner else f"{type(part).__name__}.{name}"
