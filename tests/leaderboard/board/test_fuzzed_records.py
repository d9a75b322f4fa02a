"""Damaged records by the thousand: each is refused by name, or its numbers equal plain counts."""

import importlib
import json
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from helpers import resealed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import clbench
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.scoring.layout import average
from clbench.scoring.metrics import measure

PLACES = {
    "clbench/Toy-v0": "Toy-v0/theirs--mine/seed-0.json",
    "theirs/Own-v0": "theirs--Own-v0/theirs--mine/seed-0.json",
}
"""Scenario of the damaged record, shared with the honest ones or its own, and its place."""

JUNK: tuple[Any, ...] = (None, True, False, -1, 0, 1, 2, 0.5, -0.0, 1e18, 10**300, 2**63)
JUNK += ("", "x", "skill_0", "test", "validation", "\ud800", "\x1b[31m", [], [1], {}, {"x": []})


@pytest.fixture
def board(tmp_path: Path, make_record: Callable[..., Record]) -> Path:
    """Return a folder of three honest records, and one of either scenario that is to be damaged."""
    records = tmp_path / "leaderboard" / "records"
    runs = [
        ("clbench/Toy-v0", method, seed) for method, seed in (("sft", 0), ("sft", 1), ("theirs/plain", 0))
    ]
    for scenario, method, seed in (*runs, *((scenario, "theirs/mine", 0) for scenario in PLACES)):
        record = make_record(
            [[1.0, 1.0, 0.0, 0.0, 0.0], [1.0, 0.5, 1.0, 0.5, 0.0], [0.5, 0.0, 0.5, 1.0, 0.5]],
            episodes=2,
            steps=(1, 2),
            curves=[[0.5], [1.0]],
            validation=[[0.5, 1.0], [0.5, 0.5]],
            retained_curves=[[[0.5, 1.0]], [[1.0, 0.0]]],
            validation_episodes=2,
            answers={(stage, kind): (4, 4 - stage) for stage in range(3) for kind in ("left", "above")},
            sparsity=[[0.5, 0.4], [0.3, 0.2]],
            method=method,
            scenario=scenario,
            seed=seed,
        )
        write_record(record, record_path(records, scenario, method, seed))
    return records


# ---- damage ------------------------------------------------------------------------------------------------


def edited(draw: Callable[[Any], Any], values: Any) -> None:
    """Change one thing somewhere in the tree of `values`."""
    parent, keys = values, list(values)
    key = draw(st.sampled_from(keys))
    while isinstance(parent[key], list | dict) and parent[key] and draw(st.integers(0, 5)):
        parent = parent[key]
        keys = list(range(len(parent)) if isinstance(parent, list) else parent)
        key = draw(st.sampled_from(keys))
    how = draw(st.sampled_from(("replace", "replace", "remove", "add", "swap", "copy")))
    other, junk = draw(st.sampled_from(keys)), draw(st.sampled_from(JUNK))
    if how == "replace":
        parent[key] = junk
    elif how == "remove":
        del parent[key]
    elif how == "swap":
        parent[key], parent[other] = parent[other], parent[key]
    elif how == "copy":
        parent[key] = parent[other]
    elif isinstance(parent, list):
        parent.insert(key, junk)
    else:
        parent["more"] = junk


def rearranged(draw: Callable[[Any], Any], values: Any) -> None:
    """Drop, repeat, move or change rows of one table, so that its columns still fit together."""
    table = values[draw(st.sampled_from(("episodes", "episodes", "answers", "policy")))]
    rows = [list(row) for row in zip(*table.values(), strict=True)]
    place, other = (draw(st.integers(0, len(rows) - 1)) for _ in range(2))
    how = draw(st.sampled_from(("drop", "repeat", "swap", "change", "cut", "flip")))
    if how == "drop":
        del rows[place]
    elif how == "repeat":
        rows.insert(other, rows[place])
    elif how == "swap":
        rows[place], rows[other] = rows[other], rows[place]
    elif how == "change":
        column = draw(st.integers(0, len(table) - 1))
        rows[place][column] = rows[other][column]
    elif how == "cut":
        del rows[place:]
    elif "success" in table:
        rows[place][list(table).index("success")] ^= 1
    for number, name in enumerate(table):
        table[name] = [row[number] for row in rows]


def flipped(draw: Callable[[Any], Any], content: bytes) -> bytes:
    """Change some bytes."""
    place = draw(st.integers(0, len(content) - 1))
    how = draw(st.sampled_from(("flip", "digit", "insert", "remove", "cut")))
    if how == "flip":
        return content[:place] + bytes([content[place] ^ 1 << draw(st.integers(0, 7))]) + content[place + 1 :]
    if how == "digit":
        digits = [n for n, byte in enumerate(content) if chr(byte).isdigit()]
        place = draw(st.sampled_from(digits))
        return content[:place] + str(draw(st.integers(0, 9))).encode() + content[place + 1 :]
    if how == "insert":
        return content[:place] + bytes([draw(st.integers(0, 255))]) + content[place:]
    length = draw(st.integers(1, 40))
    return content[:place] + (content[place + length :] if how == "remove" else b"")


def damaged(draw: Callable[[Any], Any], honest: str) -> bytes:
    """Return an honest record with one to three things wrong with it."""
    kind = draw(st.sampled_from(("tree", "rows", "bytes")))
    count = draw(st.integers(1, 3))
    if kind == "bytes":
        content = honest.encode()
        for _ in range(count):
            content = flipped(draw, content) if len(content) > 100 else content
        return resealed(content)
    values = json.loads(honest)
    if kind == "rows":
        for _ in range(count):
            if all(
                len(column) for name in ("episodes", "answers", "policy") for column in values[name].values()
            ):
                rearranged(draw, values)
    else:
        edited(draw, values)
    return resealed(json.dumps(values).encode())


# ---- the same numbers in another way -----------------------------------------------------------------------


def mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


class Counted:
    """A record's JSON, whose rows are counted one by one."""

    def __init__(self, content: bytes) -> None:
        self.values = json.loads(content)
        scenario, split = self.values["scenario"], self.values["run"]["split"]
        self.retained, self.targets, self.held_out = (
            scenario[group] for group in ("retained", "target", "held_out")
        )
        self.steps = scenario["evaluation_steps"]
        self.rows = [row for row in zip(*self.values["episodes"].values(), strict=True) if row[3] == split]

    def rate(self, stage: int, task: str, step: int | None = None) -> float | None:
        """Return the success on a task after a step of a stage, at its end if None."""
        last = self.steps[-1] if stage else 0
        step = last if step is None else step
        found = [row[5] for row in self.rows if (row[0], row[1], row[2]) == (stage, step, task)]
        alike = (row for row in self.rows if step == last or (row[0] and row[1] < last))
        return sum(found) / len(found) if found and len(found) == len({row[4] for row in alike}) else None

    def drop(self, task: str, first: int) -> float | None:
        """Return the best success on a task from stage `first` on, minus that at the end."""
        rates = [self.rate(stage, task) for stage in range(first, len(self.targets) + 1)]
        *before, after = (math.nan if rate is None else rate for rate in rates)
        return max(before) - after if before and None not in rates else None

    def answered(self) -> float | None:
        """Return the share of right answers at the end."""
        asked = correct = 0
        end = (len(self.targets), self.steps[-1] if self.targets else 0)
        for stage, step, _, questions, right in zip(*self.values["answers"].values(), strict=True):
            if (stage, step) == end:
                asked, correct = asked + questions, correct + right
        return correct / asked if asked else None

    def metrics(self) -> dict[str, float | None]:
        last, learned = len(self.targets), {task: stage for stage, task in enumerate(self.targets, 1)}
        known = [*self.retained, *self.targets[:-1]]
        return {
            "final_average": mean([self.rate(last, task) for task in (*self.retained, *self.targets)]),
            "adaptation": mean([self.rate(stage, task) for task, stage in learned.items()]),
            "retention": mean([self.rate(last, task) for task in self.retained]),
            "forgetting": mean([self.drop(task, learned.get(task, 0)) for task in known]),
            "zero_shot": mean([self.rate(last, task) for task in self.held_out]),
            "question_retention": self.answered(),
        }

    def check(self, scores: Any) -> None:
        """Check that the scores have these rates and metrics."""
        tasks = [*self.retained, *self.targets, *self.held_out]
        ends, curves = (average(table) for table in (scores.success, scores.on_the_way))
        for (stage, task), value in np.ndenumerate(ends):
            check_equal(value, self.rate(stage, tasks[task]))
        for (target, point, task), value in np.ndenumerate(curves):
            check_equal(value, self.rate(target + 1, tasks[task], self.steps[point]))
        for name, metric in self.metrics().items():
            check_equal(measure(name, scores), metric)


def check_equal(found: Any, expected: float | None) -> None:
    if expected is None:
        assert found is None or math.isnan(found)
    else:
        assert found == pytest.approx(expected, abs=1e-12)


# ---- the check ---------------------------------------------------------------------------------------------


def check_board(board: Path, examples: int) -> Counter[str]:
    """Check `examples` damaged records one by one, then some of those that are shown on one table."""
    runs = importlib.import_module("clbench.leaderboard.board.runs")
    honest = {scenario: (board / place).read_text(encoding="utf-8") for scenario, place in PLACES.items()}
    for place in PLACES.values():
        (board / place).unlink()
    before, _ = runs.read_runs(board, runs.read_run, runs.ALIKE)
    rows = clbench.load_board(board)
    came: Counter[str] = Counter()
    whole: dict[bytes, str] = {}

    @settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],
    )
    @given(st.data())
    def check(data: st.DataObject) -> None:
        scenario = data.draw(st.sampled_from(list(PLACES)))
        content, path = damaged(data.draw, honest[scenario]), board / PLACES[scenario]
        path.write_bytes(content)
        try:
            kept, refused = runs.read_runs(board, runs.read_run, runs.ALIKE)
        finally:
            path.unlink()
        ours = [run for run in kept if run.path != PLACES[scenario]]
        assert [run.path for run in ours] == [run.path for run in before]
        for run, old in zip(ours, before, strict=True):
            assert run.scores.layout == old.scores.layout
            assert np.array_equal(run.scores.success, old.scores.success)
        if refused:
            assert [entry.path for entry in refused] == [PLACES[scenario]]
            assert refused[0].reason
            came["refused"] += 1
        else:
            (run,) = (run for run in kept if run.path == PLACES[scenario])
            Counted(content).check(run.scores)
            came["shown"] += 1
            whole[content] = scenario

    check()
    for number, (content, scenario) in enumerate(list(whole.items())[:: max(1, len(whole) // 12)]):
        path = board / PLACES[scenario].replace("mine", f"mine{number}")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(resealed(content.replace(b"theirs/mine", f"theirs/mine{number}".encode())))
        came["in the table"] += 1
    importlib.import_module("clbench.leaderboard.cli").show(records=board)
    table = clbench.load_board(board)
    expected = rows.set_index(["scenario", "method"]).drop(columns="letters")
    after = table.set_index(["scenario", "method"]).drop(columns="letters")
    pandas.testing.assert_frame_equal(after.loc[expected.index], expected)
    for (scenario, method), row in after.drop(expected.index).iterrows():
        place = PLACES[scenario].replace("mine", method.removeprefix("theirs/"))
        for name, value in Counted((board / place).read_bytes()).metrics().items():
            check_equal(row[name], value)
    return came


@pytest.mark.long
def test_damaged_records_are_refused_or_counted_rightly(board: Path) -> None:
    came = check_board(board, 200)
    assert min(came.values()) >= 5


@pytest.mark.slow
def test_a_thousand_damaged_records_are_refused_or_counted_rightly(board: Path) -> None:
    came = check_board(board, 1200)
    assert came["shown"] + came["refused"] >= 1200
    assert min(came.values()) >= 10
