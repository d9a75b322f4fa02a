"""A folder with the records of four methods, and the leaderboard that comes from it."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clbench.base.entry_points import resolve

ANSWERS = {(stage, kind): (50, 45 - 10 * stage) for stage in range(3) for kind in ("left", "above")}
VALIDATION = [[0.3, 0.6, 0.9, 0.9], [0.1, 0.3, 0.8, 0.8]]
REFERENCE = {"demonstrations": "never", "questions": "never", "reference": True}
REPLAY = {"demonstrations": "throughout", "questions": "never", "reference": False}
ASKS = {"demonstrations": "never", "questions": "prepare", "reference": False}


@pytest.fixture
def add_full(add: Callable[..., Path]) -> Callable[..., Path]:
    """Return the function that adds a record with values for every metric."""
    policy = {"sparsity": np.full((2, 4), 0.6), "drift": np.full((2, 4), 3.0)}
    return functools.partial(add, validation=VALIDATION, answers=ANSWERS, **policy)


@pytest.fixture
def four_methods(add_full: Callable[..., Path], matrix: Any, tmp_path: Path) -> Path:
    """Return a folder with the records of four methods."""
    for seed in range(2):
        add_full("sft", seed)
        add_full("replay", seed, np.clip(matrix + 0.3, 0, 1), uses=REPLAY)
        add_full("asks", seed, uses=ASKS)
        add_full("from_scratch", seed, uses=REFERENCE)
    return tmp_path / "leaderboard" / "records"


@pytest.fixture
def shown_with_page(four_methods: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[], tuple[str, str]]:
    """Return a function that shows the leaderboard and returns the printed text and the Markdown."""

    def shown() -> tuple[str, str]:
        resolve("clbench.leaderboard.cli:show")(records=four_methods)
        page = four_methods.parent / "site" / "LEADERBOARD.md"
        return capsys.readouterr().out, page.read_text(encoding="utf-8")

    return shown


@pytest.fixture
def shown(
    shown_with_page: Callable[[], tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> Callable[[], tuple[str, str]]:
    """Return the same without the HTML page and its pictures, which take most of the time."""
    monkeypatch.setattr("clbench.leaderboard.views.page.page", lambda _: "")
    monkeypatch.setattr("clbench.leaderboard.views.page.pictures", lambda _: {})
    return shown_with_page
