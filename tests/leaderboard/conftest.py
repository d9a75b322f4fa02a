"""Folders of records: four methods with fixed stages, and any number of them at equal learning."""

import ast
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import write_unchecked

from clbench.base.entry_points import resolve
from clbench.records.paths import label_of, record_path
from clbench.records.record import Record
from clbench.scoring.intervals import estimate, estimate_quantity, paired_difference
from clbench.spec.scenario import balanced_order

EVEN = "clbench/Even-v1"
ANSWERS = {(stage, kind): (50, 45 - 10 * stage) for stage in range(3) for kind in ("left", "above")}
VALIDATION = [[0.3, 0.6, 0.9, 0.9], [0.1, 0.3, 0.8, 0.8]]
REFERENCE = {"demonstrations": "never", "questions": "never", "reference": True}
REPLAY = {"demonstrations": "throughout", "questions": "never", "reference": False}
ASKS = {"demonstrations": "never", "questions": "prepare", "reference": False}


@pytest.fixture(scope="session", autouse=True)
def _docstrings_are_read_once() -> Iterator[None]:
    """Keep the docstrings of the source: each board and each page of a method would read them again."""
    docstrings_in = resolve("clbench.leaderboard.publishing:_docstrings_in")
    fields_of = resolve("clbench.leaderboard.views.descriptions:field_docstrings")
    kept = functools.cache(lambda path, _: docstrings_in(path))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "clbench.leaderboard.publishing._docstrings_in", lambda path: kept(path, ast.get_docstring)
        )
        patch.setattr("clbench.leaderboard.views.descriptions.field_docstrings", functools.cache(fields_of))
        yield


@pytest.fixture(autouse=True)
def _few_draws(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw episodes of made-up records 200 times, not 2,000; tests of published ones are long or slow."""
    if not any(request.node.get_closest_marker(name) for name in ("long", "slow")):
        for function in (estimate, estimate_quantity, paired_difference):
            defaults = {**(function.__kwdefaults__ or {}), "replicates": 200}
            monkeypatch.setattr(function, "__kwdefaults__", defaults)


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
    monkeypatch.setattr("clbench.leaderboard.views.page.page", lambda *_: "")
    monkeypatch.setattr("clbench.leaderboard.views.page.pictures", lambda _: {})
    return shown_with_page


@pytest.fixture
def even_board(make_record: Callable[..., Record], tmp_path: Path) -> Callable[..., Path]:
    """Return a function that adds a record of a scenario at equal learning to a folder.

    It returns the folder of records.
    """

    def add(method: str, seed: int, kept: float, folder: str = "records", **changes: Any) -> Path:
        success = [[1, 1, 0, 0, 0], [kept, kept, 0.9, 0, 0], [kept, kept, kept, 0.9, 0]]
        options = {"steps": (20,), "ends": (8, 20), "settings": changes, "changes": changes}
        record = make_record(success, method=method, seed=seed, scenario=EVEN, **options)
        names = record.scenario.target
        record.scenario.balanced = True
        record.scenario.target = [names[place] for place in balanced_order(2, seed)]
        swapped = dict(zip(names, record.scenario.target, strict=True))
        record.episodes["task"] = [swapped.get(task, task) for task in record.episodes["task"]]
        path = record_path(tmp_path / folder, EVEN, label_of(method, changes), seed)
        write_unchecked(record, path)
        return tmp_path / "records"

    return add
