"""Fixtures that several test files share."""

import dataclasses
import functools
import io
import json
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import entry_points, packages_distributions
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import complete_record, write_unchecked
from rich.console import Console

from clbench.base import source
from clbench.jobs.bars import Bars
from clbench.learning.method import Method
from clbench.learning.optimise import deterministic
from clbench.learning.prior import Uses
from clbench.learning.registry import load_method
from clbench.records.paths import record_path
from clbench.records.pinned import pinned
from clbench.records.record import (
    AnswerRow,
    CheckRow,
    Costs,
    PolicyRow,
    Record,
    Relearning,
    RunInfo,
    ScenarioInfo,
)
from clbench.runs import fingerprint
from clbench.runs.length import run_length
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.scores import Scores
from clbench.spec import identifiers
from clbench.spec.identifiers import built_in_methods
from clbench.spec.protocol import check_steps
from clbench.worlds import gl_backend

collect_ignore = ["submission"]
"""A package of its own, which test_submission.py installs and tests."""


@pytest.fixture(scope="session", autouse=True)
def _own_caches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the user's caches out of the tests; all tests share one, so that the toy is pretrained once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CLBENCH_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _one_core_each() -> Iterator[None]:
    """Compute with one thread outside of runs too, also in new processes: each core has its own tests."""
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        yield


@pytest.fixture(scope="session", autouse=True)
def _short_measurements() -> Iterator[None]:
    """Measure the time of a step with two pairs of blocks: test_step_time.py has all five."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("clbench.runs.step_time.ROUNDS", 2)
        yield


@pytest.fixture(scope="session", autouse=True)
def _what_is_installed_is_listed_once() -> Iterator[None]:
    """Keep the lists of packages, entry points and our files: each run and each board would make them."""
    files_of, root = source.files_below, Path(source.__file__).resolve().parents[2]
    once = functools.cache(files_of)

    def files_below(folder: Path) -> list[Path]:
        return once(folder) if folder.is_relative_to(root) else files_of(folder)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(source, "files_below", files_below)
        patch.setattr(fingerprint, "packages_distributions", functools.cache(packages_distributions))
        patch.setattr(identifiers, "entry_points", functools.cache(entry_points))
        yield


@pytest.fixture(scope="session", autouse=True)
def _toys_can_be_drawn() -> Iterator[None]:
    """Try no back end for the toy, which draws by itself: each try starts PyTorch."""
    usual = gl_backend.rendering_fault

    def fault(back_end: str, world: str | None = None) -> str | None:
        return None if (world or "").endswith(":ToyWorld") else usual(back_end, world)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gl_backend, "rendering_fault", fault)
        yield


@pytest.fixture
def empty_caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give one test caches of its own, and return the folder that holds them."""
    monkeypatch.setenv("CLBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path


@pytest.fixture
def bars() -> Bars:
    """Bars that draw into a text: `bars.console.file`."""
    return Bars(10, Console(file=io.StringIO(), width=200))


@pytest.fixture
def write_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Return a function that writes a module, from its name and source, where tests and workers find it."""

    def write_module(name: str, source: str) -> None:
        (tmp_path / f"{name}.py").write_text(source)
        monkeypatch.syspath_prepend(tmp_path)

    return write_module


@pytest.fixture(scope="session")
def lasting_records() -> Callable[[Path], dict[str, Any]]:
    """Return a function that reads all records below a folder, without what may differ between equal runs."""

    def lasting_records(folder: Path) -> dict[str, Any]:
        found = {}
        for path in sorted(folder.rglob("*.json")):
            record = json.loads(path.read_text())
            del record["timing"], record["content"]
            del record["fingerprint"]["commit"]  # a commit may be made while a test runs
            found[path.relative_to(folder).as_posix()] = record
        return found

    return lasting_records


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Compute as a run does: with one thread, so that numbers repeat themselves."""
    with deterministic():
        yield


@pytest.fixture
def stranger(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[Method]], str]:
    """Return a function that makes a class importable and returns its "module:Class"."""

    def offer(cls: type[Method]) -> str:
        module = types.ModuleType("stranger")
        module.__dict__[cls.__name__] = cls
        monkeypatch.setitem(sys.modules, "stranger", module)
        return f"stranger:{cls.__name__}"

    return offer


class _Killed(BaseException):
    """An exception that no handler of the run catches, as if its process was killed."""


@pytest.fixture
def execute_and_kill() -> Callable[..., None]:
    """Return a function that does a run as `execute` does, and kills it after a share of its length."""

    def execute_and_kill(spec: RunSpec, records: Path, share: float, **folders: Path) -> None:
        run = spec.resolve()
        left = share * run_length(run.scenario, run.protocol)

        def die(amount: float) -> None:
            nonlocal left
            left -= amount
            if left < 0:
                raise _Killed

        with pytest.raises(_Killed):
            execute(spec, records, die, **folders)

    return execute_and_kill


@pytest.fixture(scope="session")
def matrix() -> Any:
    """Return the success rates (stages, tasks) of a method that learns and forgets."""
    return np.array([[1.0, 0.8, 0.1, 0.0, 0.2], [0.6, 0.9, 0.9, 0.2, 0.3], [0.5, 0.4, 0.3, 0.8, 0.1]])


@pytest.fixture
def add(make_record: Callable[..., Record], matrix: Any, tmp_path: Path) -> Callable[..., Path]:
    """Return a function that adds a record to leaderboard/records and returns its path."""

    def add(
        method: str = "sft",
        seed: int = 0,
        matrix: Any = matrix,
        edit: Callable[[Record], None] | None = None,
        place: str | None = None,
        **run: Any,
    ) -> Path:
        """Add a record, which `edit` changes before, at its own place or at another one."""
        on_the_way = {"curves": np.full((2, 3), 0.4), "retained_curves": np.full((2, 3, 2), 0.7)}
        record = make_record(matrix, method=method, seed=seed, **{"episodes": 10, **on_the_way, **run})
        if edit:
            edit(record)
        records = tmp_path / "leaderboard" / "records"
        path = records / place if place else record_path(records, record.run.scenario, method, seed)
        write_unchecked(record, path)
        return path

    return add


@pytest.fixture(scope="session")
def make_record() -> Callable[..., Record]:
    """Return a function that makes a record out of matrices, as a run would have left it."""
    return _make_record


@pytest.fixture(scope="session")
def scores(make_record: Callable[..., Record]) -> Callable[..., Scores]:
    """Return a function that makes the scores of a record out of matrices, see `make_record`."""
    make = functools.partial(make_record, complete=False)
    return lambda *arguments, **options: Scores.from_record(make(*arguments, **options), partial=True)


def _make_record(
    success: Any,
    *,
    curves: Any = None,
    retained_curves: Any = None,
    validation: Any = None,
    perturbed: Any = None,
    perturbed_learned: Any = None,
    sparsity: Any = None,
    drift: Any = None,
    shift: Any = None,
    captured: Any = None,
    relearning: Relearning | None = None,
    steps: tuple[int, ...] = (100, 200, 300, 400),
    answers: Mapping[tuple[int, str], tuple[int, int]] | None = None,
    groups: tuple[int, int, int] | None = None,
    episodes: int = 20,
    curve_episodes: int | None = None,
    validation_episodes: int = 10,
    ends: tuple[int, ...] | None = None,
    complete: bool = True,
    **run: Any,
) -> Record:
    """Return a record. Where a value is NaN there is no row, or None in it.

    Args:
        success: Success rates (stages + 1, tasks), or outcomes (stages + 1, tasks, episodes).
        curves: The same for the targets on the way, (targets, points before the end); none if None.
        retained_curves: The same for the retained skills, (targets, points before the end, retained).
        validation: The same for the targets on validation episodes, (targets, points).
        perturbed: The same for the retained skills in perturbed episodes at the ends, (stages + 1, retained).
        perturbed_learned: The same for each target at the end of its stage, (targets,); 0 if None.
        sparsity: Update sparsity, (targets, points). No policy was looked at if this and the next three
            are None.
        drift: Activation drift, (targets, points).
        shift: Shift of the policy in each stage, (targets,).
        captured: Captured share in each stage, (targets,).
        relearning: Relearning after the last stage.
        steps: Steps of the evaluation points; the last one ends a stage.
        answers: Questions asked and answered rightly by stage and kind, at the end of the stage.
        groups: Numbers of retained tasks, targets and held-out tasks; by default one is held out.
        episodes: Episodes per task, where rates are given.
        curve_episodes: Episodes per task on the way, where rates are given; as many as at the end if None.
        validation_episodes: Validation episodes, where rates are given.
        ends: Steps of each stage if stages have a criterion, of .9; it is met at steps before the last one.
        complete: Whether to add what the budget demands: failures, the answers before the stage at its
            points on the way, and None for changes of the policy.
        run: Fields of `Record.run`, for example method="ewc"; split="validation" holds for all episodes.
            A built-in method uses what it declares.
    """
    outcomes = _outcomes(success, 2, episodes)
    stages, tasks = outcomes.shape[0] - 1, outcomes.shape[1]
    retained, targets, held_out = groups or (tasks - stages - 1, stages, 1)
    assert (targets, retained + targets + held_out) == (stages, tasks)
    counts = {"skill": retained, "target": targets, "unseen": held_out}
    names = [f"{group}_{number}" for group, count in counts.items() for number in range(count)]
    method = run.get("method", "sft")
    uses = dict(_uses_of(method))
    names_of_run = {"scenario": "clbench/Toy-v0", "method": method, "seed": 0, "device": "cpu"}
    run = {**names_of_run, "split": "test", "settings": {}, "changes": {}, "uses": uses, **run}
    split, on_the_way = run["split"], curve_episodes or outcomes.shape[2]
    at_end = (0, *(ends or stages * steps[-1:]))
    rows: list[tuple[Any, ...]] = [
        (stage, at_end[stage], names[task], split, episode, int(value), value, 50)
        for (stage, task, episode), value in np.ndenumerate(outcomes)
        if not np.isnan(value)
    ]
    for values, which, number in (
        (curves, split, on_the_way),
        (validation, "validation", validation_episodes),
    ):
        rows += [
            (target + 1, steps[point], names[retained + target], which, episode, int(value), value, 50)
            for (target, point, episode), value in _each(values, 2, number)
        ]
    rows += [
        (target + 1, steps[point], names[task], split, episode, int(value), value, 50)
        for (target, point, task, episode), value in _each(retained_curves, 3, on_the_way)
    ]
    rows += [
        (stage, at_end[stage], names[task], "perturbed", episode, int(value), value, 50)
        for (stage, task, episode), value in _each(perturbed, 2, outcomes.shape[2])
    ]
    if perturbed is not None:
        of_targets = np.zeros(targets) if perturbed_learned is None else perturbed_learned
        rows += [
            (
                target + 1,
                at_end[target + 1],
                names[retained + target],
                "perturbed",
                episode,
                int(value),
                value,
                50,
            )
            for (target, episode), value in _each(of_targets, 1, outcomes.shape[2])
        ]
    run |= {} if perturbed is None else {"perturb": True}
    budget = {
        "adaptation_steps": steps[-1],
        "test_episodes": outcomes.shape[2],
        "curve_episodes": on_the_way,
        "validation_episodes": validation_episodes,
        "criterion": 0.9 if ends else None,
    }
    given = answers or {}
    record = Record(
        status="success",
        run=RunInfo(**run),
        scenario=ScenarioInfo(
            id=run["scenario"],
            retained=names[:retained],
            target=names[retained : retained + targets],
            held_out=names[retained + targets :],
            evaluation_steps=list(steps),
            budget=budget,
        ),
        costs=Costs(optimiser_steps=stages * steps[-1], parameters=1000, parameters_added=0, bytes_kept=0),
        fingerprint={
            "rollouts": {"toy:world": "0123"},
            "definition": dict(pinned().get(run["scenario"], {"questions": "0123"})),
        },
        relearning=relearning,
    )
    for column, values in zip(record.episodes.values(), zip(*rows, strict=True), strict=True):
        column += values
    for (stage, kind), value in given.items():
        record.add_answers(AnswerRow(stage, at_end[stage], kind, *value))
    for stage, end in enumerate(ends or (), 1):
        for step in check_steps(steps[-1]):
            if step <= end:
                met = step == end < steps[-1]
                record.add_check(CheckRow(stage, step, validation_episodes if met else 2, 9 if met else 0))
    for values in _policy_rows((sparsity, drift), (shift, captured), (stages, len(steps)), steps, at_end):
        record.add_policy(PolicyRow(*values))
    if complete:
        complete_record(record)
    return record


@functools.cache  # 1 ms for each of 3,000 records
def _uses_of(method: str) -> dict[str, Any]:
    return dataclasses.asdict(load_method(method).uses if method in built_in_methods() else Uses())


def _outcomes(values: Any, axes: int, episodes: int) -> Any:
    """Return outcomes (..., episodes) whose mean is the rates: the first episodes are the successes.

    Values with more than `axes` axes are outcomes already.
    """
    array = np.asarray(values, dtype=float)
    if array.ndim > axes:
        return array
    outcomes = (np.arange(episodes) < np.round(array * episodes)[..., None]).astype(float)
    outcomes[np.isnan(array)] = np.nan
    return outcomes


def _each(values: Any, axes: int, episodes: int) -> list[tuple[tuple[int, ...], Any]]:
    """Return the outcomes with their indices, without NaN; none if `values` is None."""
    if values is None:
        return []
    outcomes = np.ndenumerate(_outcomes(values, axes, episodes))
    return [(place, value) for place, value in outcomes if not np.isnan(value)]


def _policy_rows(
    at_points: tuple[Any, ...],
    of_stages: tuple[Any, ...],
    shape: tuple[int, int],
    steps: tuple[int, ...],
    at_end: tuple[int, ...],
) -> list[tuple[Any, ...]]:
    """Return the rows of the policy table, including the pretrained policy's; none without values."""
    if all(values is None for values in (*at_points, *of_stages)):
        return []
    tables = np.full((len(at_points) + len(of_stages), *shape), np.nan)
    for table, values in zip(tables, at_points, strict=False):
        table[:] = np.nan if values is None else values
    for table, values in zip(tables[len(at_points) :], of_stages, strict=True):
        table[:, -1] = np.nan if values is None else values
    rows: list[tuple[Any, ...]] = [(0, 0, 1.0, 0.0, None, None)]
    for target, point in np.ndindex(shape):
        step = at_end[target + 1] if point == shape[1] - 1 else steps[point]
        values = (None if np.isnan(value) else float(value) for value in tables[:, target, point])
        rows.append((target + 1, step, *values))
    return rows
