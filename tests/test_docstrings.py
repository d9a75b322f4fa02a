"""Docstrings say what the code does."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted(
    path for part in ("clbench", "envs", "methods", "leaderboard") for path in (ROOT / part).rglob("*.py")
)
BASES = "LookupError|ValueError|TypeError|RuntimeError|FileNotFoundError"
"""Built-in exceptions from which errors of clbench derive, see `clbench.base.errors`."""


@pytest.mark.parametrize("base", BASES.split("|"))
def test_a_section_on_errors_names_the_class_that_is_raised_and_not_its_base(base: str) -> None:
    wrong = []
    for path in MODULES:
        text = path.read_text(encoding="utf-8")
        if re.search(rf"^ +{base}: [A-Z`]", text, re.MULTILINE) and f"raise {base}(" not in text:
            wrong.append(path.relative_to(ROOT).as_posix())
    assert not wrong
