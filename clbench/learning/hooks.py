"""Checks of a method's hooks: which are misspelt, which the loop cannot call, and which raised an error."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from itertools import takewhile
from traceback import walk_tb
from types import FrameType, FunctionType
from typing import Any

from clbench.base.source import functions_behind, names_in
from clbench.base.text import did_you_mean
from clbench.learning.method import Metadata, Method
from clbench.learning.prior import Uses

HOOKS = (
    "watch_pretraining",
    "prepare",
    "start_task",
    "batch",
    "loss",
    "gradients",
    "learning_rate",
    "end_task",
    "state",
    "load_state",
    "diagnostics",
)
"""Hooks of `Method`, in the order in which a run calls them."""


def own_classes(cls: type[Method]) -> list[type]:
    """Return a method's class and its bases before `Method`, in the order in which Python looks them up."""
    return list(takewhile(lambda base: base is not Method, cls.__mro__))


def functions_of(cls: type) -> dict[str, FunctionType]:
    """Return the functions that a class itself defines, without their decorators, by name."""
    plain = {name: getattr(value, "__func__", value) for name, value in vars(cls).items()}
    return {name: inspect.unwrap(one) for name, one in plain.items() if isinstance(one, FunctionType)}


def uncalled_functions(cls: type[Method]) -> dict[str, str]:
    """Return the public functions of a method that neither the loop nor the class calls.

    The value for each is the end of a message with the hook of the nearest name, empty if none is near.
    """
    functions = [name for base in own_classes(cls) for name in functions_of(base)]
    behind = [
        one for base in own_classes(cls) for value in vars(base).values() for one in functions_behind(value)
    ]
    used = set(HOOKS).union(*(names_in(one.__code__) for one in behind))
    uncalled = [name for name in functions if not name.startswith("_") and name not in used]
    return {name: did_you_mean(f"{name}()", [f"{hook}()" for hook in HOOKS]) for name in uncalled}


def misfits(cls: type[Method]) -> dict[str, tuple[str, str]]:
    """Return the hooks that the loop cannot call, each with its arguments in `Method` and in the class.

    A value in the place of a hook, such as a field with the hook's name, appears as "the value 0.5".
    """
    found = {}
    for hook in HOOKS:
        given, own = inspect.signature(getattr(Method, hook)).parameters, getattr(cls, hook)
        arguments = f"({', '.join(given)})"
        if not callable(own):
            found[hook] = arguments, f"the value {own!r}"
            continue
        taken = inspect.signature(own)
        try:
            taken.bind(*given)
        except TypeError:
            found[hook] = arguments, f"({', '.join(taken.parameters)})"
    return found


DECLARATIONS: dict[str, tuple[Any, str]] = {
    "uses": (Uses, "a Uses"),
    "metadata": (Metadata, "a Metadata"),
    "tunes": (tuple | None, "a tuple of a hyper-parameter's name and two values of it, or None"),
    "needs": (tuple, "a tuple of abilities of a policy"),
    "whole_stages": (bool, "a bool"),
}
"""Types of the declarations of a class besides its hyper-parameters, with their descriptions."""


def misdeclared(cls: type[Method]) -> dict[str, str]:
    """Return the declarations of a class that have the wrong type, each with the right type in words."""
    return {
        name: words
        for name, (kind, words) in DECLARATIONS.items()
        if not isinstance(getattr(cls, name), kind)
    }


def place_of(error: BaseException, place: str) -> str:
    """Return a place in a run with the hook that raised an error, such as "loss() of stage 1 (push)".

    Args:
        error: The error, with its traceback and those of the errors that caused it.
        place: The stage or the hook that ran.
    """
    for frame in _frames_of_method(error):
        hook = frame.f_code.co_name
        if hook in HOOKS:
            called = place.partition(" ")[0].removesuffix("()") == hook
            return place if called else f"{hook}() of {place}"
    return place


def comes_from_method(error: BaseException) -> bool:
    """Return whether a function of a method ran when an error, or one that caused it, was raised."""
    return next(_frames_of_method(error), None) is not None


def _frames_of_method(error: BaseException) -> Iterator[FrameType]:
    """Yield the frames of methods in which an error, and then each that caused it, was raised."""
    cause: BaseException | None = error
    while cause is not None:
        for frame, _ in walk_tb(cause.__traceback__):
            if isinstance(frame.f_locals.get("self"), Method):
                yield frame
        cause = cause.__cause__
