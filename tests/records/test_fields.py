"""Dataclasses from JSON: each field is there and has its type, and no other field is."""

from dataclasses import dataclass
from typing import Any, Literal

import pytest

from clbench.base.errors import InputError
from clbench.records.fields import load_fields


@dataclass
class Part:
    """A dataclass inside another."""

    size: float
    names: list[str]


@dataclass
class Whole:
    """A field of every kind."""

    kind: Literal["large", "small"]
    count: int | None
    part: Part
    other: Part | None
    free: Any
    parts: list[Part]


GOOD: dict[str, Any] = {
    "kind": "large",
    "count": 3,
    "part": {"size": 1, "names": ["a"]},
    "other": {"size": 2, "names": []},
    "free": [{}],
    "parts": [{"size": 0.5, "names": []}],
}


def test_nested_dataclasses_lists_and_unions_are_loaded() -> None:
    expected = Whole("large", 3, Part(1, ["a"]), Part(2, []), [{}], [Part(0.5, [])])
    assert load_fields(Whole, GOOD, "a whole") == expected
    assert load_fields(Whole, {**GOOD, "count": None}, "a whole").count is None
    assert load_fields(Whole, {**GOOD, "other": None}, "a whole").other is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": "huge"}, "kind must be large or small, not 'huge'."),
        ({"kind": 1}, "kind must be large or small, not 1."),
        ({"count": True}, "count must be a whole number or null, not true."),
        ({"count": 3.0}, "count must be a whole number or null, not 3.0."),
        ({"part": []}, r"part must be an object with named entries, not \[\]."),
        ({"part": {"size": 1}}, "part: names is missing."),
        ({"other": []}, r"other must be an object with named entries or null, not \[\]."),
        ({"other": {"size": 1}}, "other: names is missing."),
        ({"part": {}}, "part: size, names are missing."),
        ({"part": {"size": True, "names": []}}, "part: size must be a number, not true."),
        ({"part": {"size": 1, "names": "a"}}, 'part: names must be a list, not "a".'),
        ({"part": {"size": 1, "names": ["a", 1]}}, "an entry of part: names must be a string, not 1."),
        ({"parts": [{"size": 1}]}, "an entry of parts: names is missing."),
        ({"fre": 1}, "No field of a whole is called 'fre'. Did you mean 'free'?"),
    ],
)
def test_a_value_of_another_type_or_name_is_refused_by_the_name_of_its_field(
    change: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        load_fields(Whole, {**GOOD, **change}, "a whole")
