"""The hash of a class that was typed at a prompt: it follows the code and the plain values of the class."""

import enum
import functools
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch

from clbench.base.source import class_hash
from clbench.learning.prior import Uses

CLASS = """
class Some:
    number = {number}

    def ask(self, name):
        return name in {{"one", "two", "{name}"}}

    @property
    def size(self):
        return {size}

    @{decorator}
    def end(self):
        return {end}

    @functools.cached_property
    def limit(self):
        return {limit}

    def scaled(self, by={by}):
        return by

    @functools.cache
    def kept(self):
        return {kept}

    half = functools.partialmethod(scaled, {half})
    table = {table}
"""

USUAL: dict[str, Any] = {
    "number": 1,
    "name": "three",
    "size": 4,
    "end": 6,
    "limit": 8,
    "by": 10,
    "kept": 12,
    "half": 14,
    "table": {"a": [1, 2]},
    "decorator": "torch.no_grad()",
}


def test_the_hash_of_a_typed_class_follows_its_code_and_values_and_not_its_place() -> None:
    def hashed(text: str) -> str:
        space: dict[str, Any] = {"torch": torch, "functools": functools}
        exec(text, space)
        return class_hash(space["Some"])

    before = hashed(CLASS.format(**USUAL))
    assert hashed("# a remark\n\n" + CLASS.format(**USUAL)) == before
    for change in (
        {"number": 2},
        {"name": "four"},
        {"size": 5},
        {"end": 7},
        {"limit": 9},
        {"by": 11},
        {"kept": 13},
        {"half": 15},
        {"table": {"a": [1, 3]}},
        {"decorator": "staticmethod"},
    ):
        assert hashed(CLASS.format(**USUAL | change)) != before


class _Answers:
    """Has every attribute."""

    def __getattr__(self, name: str) -> Any:
        return self


def _wraps_itself() -> None:
    """Do nothing."""


_wraps_itself.__wrapped__ = _wraps_itself  # type: ignore[attr-defined]
_HOLDS_ITSELF: list[Any] = [1]
_HOLDS_ITSELF.append(_HOLDS_ITSELF)
_DOUBLED: list[Any] = [1]
_CHAIN: list[Any] = [1]
for _ in range(100):
    _DOUBLED = [_DOUBLED, _DOUBLED]
for _ in range(2000):
    _CHAIN = [_CHAIN]


@pytest.mark.parametrize(
    "value",
    [_Answers(), _wraps_itself, _HOLDS_ITSELF, _DOUBLED, _CHAIN, mock.call, mock.MagicMock()],
    ids=["any attribute", "wraps itself", "holds itself", "doubled", "chain", "call", "mock"],
)
def test_a_value_without_end_has_a_hash(value: Any) -> None:
    assert len(class_hash(type("Some", (), {"value": value}))) == 16


class Timed:
    """Decorates a method, as an object that can be called."""

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)  # type: ignore[arg-type]


class Mode(enum.Enum):
    """Is one of two choices."""

    SLOW = frozenset("abcd")
    FAST = frozenset("efgh")


def _doubled(self: Any, value: Any) -> Any:
    return 2 * value


def _tripled(self: Any, value: Any) -> Any:
    return 3 * value


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Uses(demonstrations="prepare"), Uses(demonstrations="throughout")),
        ((Path("a"), 1), (Path("b"), 1)),
        (functools.singledispatchmethod(_doubled), functools.singledispatchmethod(_tripled)),
        (property(fset=_doubled), property(fset=_tripled)),
        (Timed(_doubled), Timed(_tripled)),
        (Mode.SLOW, Mode.FAST),
    ],
)
def test_the_hash_of_a_typed_class_follows_a_value_or_a_descriptor(one: Any, other: Any) -> None:
    first, second = (class_hash(type("Some", (), {"value": value})) for value in (one, other))
    assert first != second


@pytest.mark.long
def test_the_hash_of_a_typed_class_is_the_same_in_every_process() -> None:
    text = CLASS.format(**USUAL)
    imports = "import functools, torch\nfrom clbench.base.source import class_hash\n"
    code = f"{imports}{text}\nprint(class_hash(Some))"
    command = [sys.executable, "-c", code]
    environments = [{**os.environ, "PYTHONHASHSEED": seed} for seed in ("1", "2")]
    first, second = (
        subprocess.run(command, capture_output=True, text=True, check=True, env=one).stdout
        for one in environments
    )
    assert first == second
