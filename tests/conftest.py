"""Fixtures that several test files share."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clbench.record import ANSWER_COLUMNS, EPISODE_COLUMNS, Record


@pytest.fixture(scope="session", autouse=True)
def _own_caches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the user's caches out of the tests; all tests share one, so that the toy is pretrained once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CLBENCH_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield


@pytest.fixture
def empty_caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give one test caches of its own, and return the folder that holds them."""
    monkeypatch.setenv("CLBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path


@pytest.fixture
def make_record() -> Callable[..., Record]:
    """Return a function that makes a record out of matrices, as a run would have left it."""
    return _make_record


def _make_record(
    success: Any,
    *,
    curves: Any = None,
    steps: tuple[int, ...] = (100, 200, 300, 400),
    answers: Mapping[tuple[int, str], tuple[int, int]] | None = None,
    groups: tuple[int, int, int] | None = None,
    episodes: int = 20,
    **run: Any,
) -> Record:
    """Return a record.

    Args:
        success: Success rates (stages + 1, tasks), or outcomes (stages + 1, tasks, episodes); NaN: no row.
        curves: The same for the targets on the way, (targets, points before the end); none if None.
        steps: Steps of the evaluation points; the last one ends a stage.
        answers: Questions asked and answered rightly by stage and kind.
        groups: How many tasks are retained, targets and held out; by default one is held out.
        episodes: Episodes per task, where rates are given.
        run: What differs in `Record.run`, as method="ewc".
    """
    outcomes = _outcomes(success, episodes)
    stages, tasks = outcomes.shape[0] - 1, outcomes.shape[1]
    retained, targets, held_out = groups or (tasks - stages - 1, stages, 1)
    assert (targets, retained + targets + held_out) == (stages, tasks)
    counts = {"skill": retained, "target": targets, "unseen": held_out}
    names = [f"{group}_{number}" for group, count in counts.items() for number in range(count)]
    rows = [
        (stage, steps[-1] if stage else 0, names[task], "report", episode, int(value), value, 50)
        for (stage, task, episode), value in np.ndenumerate(outcomes)
        if not np.isnan(value)
    ]
    if curves is not None:
        rows += [
            (target + 1, steps[point], names[retained + target], "report", episode, int(value), value, 50)
            for (target, point, episode), value in np.ndenumerate(_outcomes(curves, episodes))
            if not np.isnan(value)
        ]
    uses = {"demonstrations": "never", "questions": "never", "reference": False}
    names_of_run = {"scenario": "clbench/Toy-v0", "method": "sft", "seed": 0}
    run = {**names_of_run, "settings": {}, "changes": {}, "uses": uses, **run}
    return Record(
        status="success",
        run=run,
        scenario={
            "id": run["scenario"],
            "retained": names[:retained],
            "target": names[retained : retained + targets],
            "held_out": names[retained + targets :],
            "budget": {"adaptation_steps": steps[-1], "report_episodes": outcomes.shape[2]},
        },
        episodes=_columns(EPISODE_COLUMNS, rows),
        answers=_columns(ANSWER_COLUMNS, [(*key, *value) for key, value in (answers or {}).items()]),
        costs={
            "optimiser_steps": stages * steps[-1],
            "parameters": 1000,
            "parameters_added": 0,
            "bytes_kept": 0,
        },
        fingerprint={"rollouts": {"toy:world": "0123"}},
    )


def _outcomes(values: Any, episodes: int) -> Any:
    """Return outcomes (..., episodes) whose mean is the rates: the first episodes are the successes."""
    array = np.asarray(values, dtype=float)
    if array.ndim == 3:
        return array
    outcomes = (np.arange(episodes) < np.round(array * episodes)[..., None]).astype(float)
    outcomes[np.isnan(array)] = np.nan
    return outcomes


def _columns(names: tuple[str, ...], rows: list[tuple[Any, ...]]) -> dict[str, list[Any]]:
    return {name: [row[number] for row in rows] for number, name in enumerate(names)}
