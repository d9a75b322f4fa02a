"""The hash of a record's content: equal for equal values, different for different ones."""

from typing import Any

import pytest

from clbench.records.content import content_hash

VALUES = {"schema": 3, "run": {"seed": 0, "settings": {"a": 1.0, "b": ["ï", None]}}}


def test_the_hash_is_that_of_the_canonical_json() -> None:
    # python -c 'import hashlib; print(hashlib.sha256(b"""{"schema":3,"x":[1,"\\u00ef"]}""").hexdigest())'
    expected = "287a29938a5477327d97f6a4336256f31f2bb8fb3915265f5ce4d13e0cf6c5ab"
    assert content_hash({"x": [1, "ï"], "schema": 3, "content": "left out"}) == expected


@pytest.mark.parametrize(
    "other",
    [
        {**VALUES, "schema": 2},
        {**VALUES, "more": None},
        {**VALUES, "run": {"seed": False, "settings": {"a": 1.0, "b": ["ï", None]}}},
        {**VALUES, "run": {"seed": 0, "settings": {"a": 1, "b": ["ï", None]}}},
        {**VALUES, "run": {"seed": 0, "settings": {"a": 1.0, "b": [None, "ï"]}}},
    ],
)
def test_another_value_type_or_order_of_a_list_is_another_hash(other: dict[str, Any]) -> None:
    assert content_hash(other) != content_hash(VALUES)
