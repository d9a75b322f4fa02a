"""JSON from strangers: everything has a limit, and the error names it."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from clbench.base.strict_json import (
    DEEPEST,
    LONGEST_NAME,
    LONGEST_TEXT,
    MOST_BYTES,
    StrictJSONError,
    read_json,
)


def nested(depth: int) -> Any:
    return json.loads("[" * depth + "]" * depth)


@pytest.mark.parametrize(
    "value",
    [
        {"a": [1, 2.5, None, True, "x", {"b": []}]},
        {"deep": nested(DEEPEST - 1)},
        {"x" * LONGEST_NAME: "y" * LONGEST_TEXT},
        [2**64 - 1, -(2**64) + 1, 1e308],
        "\ud800",
        7,
    ],
)
def test_json_within_the_limits_is_read(value: Any, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(value), encoding="utf-8")
    assert read_json(tmp_path / "a.json") == value


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "a": 1}', "the name 'a' is there twice in one object"),
        ('[{"b": {"a": 1, "c": 2, "a": 1}}]', "the name 'a' is there twice in one object"),
        ("[NaN]", "NaN is not a JSON number"),
        ('{"a": [1e999]}', "a: a number that is not finite"),
        (f'{{"a": {2**64}}}', "a: a whole number of 65 bits"),
        (f'{{"a": [{-(2**64)}, []]}}', "a: a whole number of 65 bits"),
        (f'{{"a": [{-(2**64)}, 1, true]}}', "a: a whole number of 65 bits"),
        # they share a hash: a set of them takes minutes
        (json.dumps([number * (2**61 - 1) for number in range(100_000)]), "a whole number of 7. bits"),
        (f'{{"a": {json.dumps(nested(DEEPEST))}}}', "a: nested more than 16 deep"),
        (f'{{"{"x" * (LONGEST_NAME + 1)}": 1}}', "a name of 201 characters"),
        (f'["{"x" * (LONGEST_TEXT + 1)}"]', "a string of 100,001 characters"),
        ("\ufeff{}", "cannot be read as JSON"),
        ("{} {}", "cannot be read as JSON"),
    ],
)
def test_json_beyond_the_limits_is_refused(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(text, encoding="utf-8")
    with pytest.raises(StrictJSONError, match=words):
        read_json(tmp_path / "a.json")


def test_a_large_file_is_refused_unread(tmp_path: Path) -> None:
    (tmp_path / "a.json").touch()
    os.truncate(tmp_path / "a.json", MOST_BYTES + 1)
    with pytest.raises(StrictJSONError, match="has 8,388,609 bytes, more than 8,388,608"):
        read_json(tmp_path / "a.json")


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{}", encoding="utf-8")
    (tmp_path / "link.json").symlink_to(tmp_path / "a.json")
    os.mkfifo(tmp_path / "pipe.json")
    for path, words in (
        (tmp_path / "link.json", "is a symbolic link"),
        (tmp_path / "pipe.json", "is not a regular file"),
        (Path(os.devnull), "is not a regular file"),
        (tmp_path, "cannot be read"),
        (tmp_path / "absent.json", "cannot be read"),
    ):
        with pytest.raises(StrictJSONError, match=words):
            read_json(path)


@pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="Linux has files that grow while they are read"
)
def test_a_file_that_changes_its_size_is_refused() -> None:
    with pytest.raises(StrictJSONError, match="changed its size while it was read"):
        read_json(Path("/proc/self/stat"))
