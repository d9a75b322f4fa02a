"""Submissions of strangers: a dishonest record is refused with its fault, and changes nothing else."""

import importlib
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import sealed

from clbench.records.paths import record_path
from clbench.records.record import SCHEMA, Record
from clbench.records.writer import write_record

SCENARIO = "clbench/Toy-v0"
MINE = "Toy-v0/theirs--mine/seed-0.json"
ABSENT = object()
"""Takes the place of a value that is removed."""


@pytest.fixture
def board(tmp_path: Path, make_record: Callable[..., Record]) -> Path:
    """Return a folder of records with three honest ones, and a stranger's at `MINE`."""
    records = tmp_path / "leaderboard" / "records"
    for method, seed in (("sft", 0), ("sft", 1), ("theirs/plain", 0), ("theirs/mine", 0)):
        record = make_record(
            [[1.0, 0.0], [0.5, 1.0]],
            groups=(1, 1, 0),
            episodes=2,
            steps=(1, 2),
            curves=[[0.5]],
            validation=[[0.5, 1.0]],
            retained_curves=[[[0.5]]],
            answers={(stage, "left"): (4, 3) for stage in (0, 1)},
            sparsity=[[0.5, 0.4]],
            method=method,
            seed=seed,
        )
        write_record(record, record_path(records, SCENARIO, method, seed))
    return records


def shown(records: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the success of the runs that are shown by path, and why the other files are not."""
    runs = importlib.import_module("clbench.leaderboard.board.runs")
    kept, refused = runs.read_runs(records, runs.read_run, runs.ALIKE)
    return {run.path: run.scores.success for run in kept}, {entry.path: entry.reason for entry in refused}


def check_refused(records: Path, damage: Callable[[], None], path: str, reason: str) -> None:
    """Check that after `damage` the file at `path` is refused, and that nothing else is touched."""
    before, _ = shown(records)
    damage()
    listing = sorted((one, one.lstat().st_mtime_ns) for one in records.parent.rglob("*"))
    after, refused = shown(records)
    assert list(refused) == [path]
    assert reason in refused[path]
    assert str(records) not in refused[path]
    before.pop(path, None)
    assert list(after) == list(before)
    assert all(np.array_equal(after[one], before[one]) for one in after)
    assert sorted((one, one.lstat().st_mtime_ns) for one in records.parent.rglob("*")) == listing


def put(values: Any, field: str, value: Any) -> None:
    """Set what the dotted `field` names, or remove it if `value` is `ABSENT`."""
    *parents, last = (int(key) if key.isdigit() else key for key in field.split("."))
    for key in parents:
        values = values[key]
    if value is ABSENT:
        del values[last]
    else:
        values[last] = value


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


NAMES = [
    ("run.method", "../../../sft", "cannot be the name of a method"),
    ("run.method", "/etc/passwd", "cannot be the name of a method"),
    ("run.method", "a/b/c", "cannot be the name of a method"),
    ("run.method", "a\\b", "cannot be the name of a method"),
    ("run.method", "theirs--mine", "cannot be the name of a method"),
    ("run.method", "..", "cannot be the name of a method"),
    ("run.method", ".hidden", "cannot be the name of a method"),
    ("run.method", "-rf", "cannot be the name of a method"),
    ("run.method", "", "cannot be the name of a method"),
    ("run.method", "sft\x1b[31m\n| best | 1.00 |", "cannot be the name of a method"),
    ("run.method", "s\u0491t", "cannot be the name of a method"),  # another alphabet
    ("run.method", "os:system('rm')", "cannot be the name of a method"),
    ("run.method", "x" * 101, "cannot be the name of a method"),
    ("run.method", "SFT", "would take for 'sft'"),
    ("run.method", "s-f_t", "would take for 'sft'"),
    ("run.method", "l0ra", "would take for 'lora'"),
    ("run.method", "jo1nt", "would take for 'joint'"),
    ("run.method", "s/ft", "would take for 'sft'"),
    ("run.method", "clbench/better", "Names of built-in methods have no package"),
    ("run.method", "clbench.methods.sft:SFT", "Names of built-in methods have no package"),
    ("run.method", "CLBench/better", "would take for a method of clbench"),
    ("run.method", "nul", "the name of a device on Windows"),
    ("run.method", "con:Con", "the name of a device on Windows"),
    ("run.scenario", "Toy-v0", "cannot be the id of a scenario"),
    ("run.scenario", "clbench/../../Toy-v0", "cannot be the id of a scenario"),
    ("run.scenario", "clbench/Toy-v0\n## Toy", "cannot be the id of a scenario"),
    ("run.scenario", "clbench/fetch-v1", "would take for 'clbench/Fetch-v1'"),
    ("run.scenario", "c1bench/Unknown-v0", "would take for a scenario of clbench"),
    ("run.scenario", "theirs/Toy-v0", "its id is 'clbench/Toy-v0', but 'theirs/Toy-v0' was run"),
    ("scenario.retained.0", "<script>", "'<script>' cannot be the name of a task"),
    ("answers.kind.0", "../left", "'../left' cannot be the name of a kind of question"),
]

FIELDS = [
    ("schema", 1, f"a whole number from 2 to {SCHEMA}"),
    ("schema", 2, "run: order must be above 0 in schema 2"),
    ("schema", SCHEMA + 1, f"has schema {SCHEMA + 1}, which is newer than {SCHEMA}: update clbench"),
    ("schema", "3", f"a whole number from 2 to {SCHEMA}"),
    ("score", 0.99, f"No field of a record of schema {SCHEMA} is called 'score'"),
    ("costs", ABSENT, f"a record of schema {SCHEMA}: costs is missing"),
    ("costs.bytes_kept", -1, "costs: bytes_kept must not be below 0"),
    ("costs.optimiser_steps", "few", "costs: optimiser_steps must be a whole number"),
    ("costs.parametres", 1, "No field of costs is called 'parametres'. Did you mean 'parameters'?"),
    ("status", "great", "status must be success or failed, not 'great'"),
    ("error", {"where": "loss"}, "error must be null"),
    ("run", [], "run must be an object with named entries"),
    ("run.seed", ABSENT, "run: seed is missing"),
    ("run.sede", 0, "No field of run is called 'sede'. Did you mean 'seed'?"),
    ("run.seed", -1, "-1 cannot be a seed"),
    ("run.seed", True, "run: seed must be a whole number, not true"),
    ("run.seed", 0.0, "run: seed must be a whole number, not 0.0"),
    ("run.split", "validation", "it is a tuning run"),
    ("run.uses.questions", "sometimes", "uses must say when demonstrations and questions are used"),
    ("run.uses.reference", "false", "reference of uses must be true or false"),
    ("run.changes", {"speed": 2}, "settings were changed: speed"),
    ("scenario.score", 1, "No field of scenario is called 'score'"),
    ("scenario.budget", 5, "scenario: budget must be an object"),
    ("scenario.evaluation_steps", list(range(1, 102)), "101 evaluation_steps; the limit is 100"),
    ("diagnostics.deep", nested(17), "diagnostics: nested more than 16 deep"),
    ("diagnostics.text", "x" * 100_001, "diagnostics: a string of 100,001 characters"),
    ("diagnostics", {"x" * 201: 1}, "a name of 201 characters"),
    ("diagnostics.number", 2**64, "diagnostics: a whole number of 65 bits"),
    ("fingerprint", None, "fingerprint must be an object"),
    ("fingerprint.rollouts", {"toy:world": "4567"}, "the rollouts of toy:world differ"),
    ("scenario.budget.learning_rate", 1.0, "its scenario does not match most records: budget"),
]

ROWS = [
    ("episodes.stage", [], "the columns of episodes have different lengths"),
    ("episodes.reward", [1.0], "episodes must have the columns"),
    ("episodes", None, "episodes must be an object with named entries"),
    ("answers.kind", "left", "answers: kind must be a list."),
    ("episodes.task.0", ["skill_0"], "episodes: task must not hold lists or objects"),
    ("episodes.task.0", "unseen", "row 0 is of a task that is not in the scenario: 'unseen'"),
    ("episodes.stage.0", 9, "row 0 has an impossible stage or step"),
    ("episodes.step.0", 2, "which is not an evaluation point"),
    ("episodes.split.0", "train", "row 0 has the split 'train'"),
    ("episodes.episode.0", -1, "row 0 has an impossible number of an episode"),
    ("episodes.episode.0", 1, "an episode is there twice"),
    ("episodes.episode.0", 7, "the test episode 0 of skill_0 is missing at stage 0, step 0"),
    ("episodes.success.0", 0.5, "row 0 has the success 0.5"),
    ("episodes.return.0", "1.0", "row 0 has an impossible return"),
    ("episodes.length.0", -5, "row 0 has an impossible length"),
    ("answers.correct.0", 5, "row 0 has impossible numbers"),
    ("answers.asked.0", True, "row 0 must hold whole numbers"),
    ("policy.update_sparsity.0", 1.5, "row 0 has an impossible update_sparsity"),
    ("policy.activation_drift.0", 1e300, "row 0 has an impossible activation_drift"),
]


@pytest.mark.parametrize(("field", "value", "reason"), [*NAMES, *FIELDS, *ROWS])
def test_an_impossible_record_is_refused_with_its_fault(
    field: str, value: Any, reason: str, board: Path
) -> None:
    def damage() -> None:
        values = json.loads((board / MINE).read_text(encoding="utf-8"))
        put(values, field, value)
        (board / MINE).write_text(json.dumps(sealed(values)), encoding="utf-8")

    check_refused(board, damage, MINE, reason)


def replaced(old: str, new: str) -> Callable[[Path], None]:
    """Return what replaces the first `old` in a file."""

    def damage(path: Path) -> None:
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new, 1), encoding="utf-8")

    return damage


def written(content: bytes) -> Callable[[Path], Any]:
    return lambda path: path.write_bytes(content)


def encoded(path: Path) -> None:
    path.write_text(path.read_text(encoding="utf-8"), encoding="utf-16")


def marked(path: Path) -> None:
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())


def inflated(path: Path) -> None:
    os.truncate(path, 2**33)


def linked(path: Path) -> None:
    target = path.parents[3] / "elsewhere.json"
    path.rename(target)
    path.symlink_to(target)


def piped(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def replaced_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


FILES = [
    (written(b""), "cannot be read as JSON"),
    (written(b"{"), "cannot be read as JSON"),
    (written(b"\x00" * 64), "cannot be read as JSON"),
    (written(b"\xff\xfe{"), "cannot be read as JSON"),
    (written(b"[" * 100_000), "cannot be read as JSON"),
    (written(b"[]"), "found no object"),
    (written(b"{'schema': 3}"), "cannot be read as JSON"),
    (written(pickle.dumps({"schema": 3})), "cannot be read as JSON"),
    (encoded, "cannot be read as JSON"),
    (marked, "cannot be read as JSON"),
    (inflated, "has 8,589,934,592 bytes, more than 8,388,608"),
    (linked, "is a symbolic link"),
    (piped, "is not a regular file"),
    (replaced_by_folder, "cannot be read (Is a directory)"),
    (replaced('"schema": ', '"schema": 5, "schema": '), "the name 'schema' is there twice"),
    (replaced('"seed": 0', '"seed": 0, "seed": 1'), "the name 'seed' is there twice"),
    (replaced('"seed": 0', '"seed": ' + "9" * 5000), "cannot be read as JSON"),
    (replaced("0.5", "NaN"), "NaN is not a JSON number"),
    (replaced("0.5", "-Infinity"), "-Infinity is not a JSON number"),
    (replaced("0.5", "1e999"), "a number that is not finite"),
]


@pytest.mark.parametrize(("damage", "reason"), FILES)
def test_a_file_that_is_no_record_is_refused_with_its_fault(
    damage: Callable[[Path], Any], reason: str, board: Path
) -> None:
    check_refused(board, lambda: damage(board / MINE), MINE, reason)


CLAIMS = [
    (
        "sft",
        9,
        "Toy-v0/theirs--mine/seed-9.json",
        {},
        "it belongs at Toy-v0/sft/seed-9.json in the folder",
    ),
    (
        "theirs/mine",
        9,
        "Toy-v0/sft/seed-9.json",
        {},
        "it belongs at Toy-v0/theirs--mine/seed-9.json in the",
    ),
    (
        "sft",
        9,
        "Toy-v0/sft/seed-9.json",
        {"uses.questions": "throughout"},
        "uses do not match sft: questions",
    ),
    ("sft", 9, "Toy-v0/sft/seed-9.json", {"uses.reference": True}, "uses do not match sft: reference"),
    ("sft", 9, "Toy-v0/sft/seed-9.json", {"settings.boost": 2}, "settings do not match sft: boost"),
    ("lora", 9, "Toy-v0/lora/seed-9.json", {"settings.rank": 2}, "settings do not match lora: rank"),
]


@pytest.mark.parametrize(("method", "seed", "place", "changes", "reason"), CLAIMS)
def test_a_record_cannot_claim_to_be_of_another_run(
    method: str, seed: int, place: str, changes: dict[str, Any], reason: str, board: Path
) -> None:
    def damage() -> None:
        values = json.loads((board / MINE).read_text(encoding="utf-8"))
        values["run"].update(method=method, seed=seed)
        for field, value in changes.items():
            put(values["run"], field, value)
        path = board / place
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(sealed(values)), encoding="utf-8")

    check_refused(board, damage, place, reason)


def many_rows(values: Any) -> None:
    values["policy"] = {name: [0] * 200_001 for name in values["policy"]}


def many_tasks(values: Any) -> None:
    values["scenario"]["held_out"] = [f"unseen_{number}" for number in range(6000)]


def many_kinds(values: Any) -> None:
    kinds = [f"kind_{number}" for number in range(6000)]
    values["answers"] = {"stage": [0] * 6000, "step": [0] * 6000, "kind": kinds}
    values["answers"] |= {"asked": [1] * 6000, "correct": [1] * 6000}


def many_episodes(values: Any) -> None:
    columns = values["episodes"]
    for name, column in columns.items():
        columns[name] = [column[0]] * 10_001
    columns["episode"] = list(range(10_001))


@pytest.mark.parametrize(
    ("grow", "reason"),
    [
        (many_rows, "policy has 200,001 rows, more than 200,000"),
        (many_tasks, "stages x points x tasks are 2 x 2 x 6,002, and the limit is 20,000"),
        (many_kinds, "stages x points x kinds of questions are 2 x 2 x 6,000, and the limit is 20,000"),
        (many_episodes, "tasks x episodes are 2 x 10,001, and the limit is 20,000"),
    ],
)
def test_a_record_that_would_take_all_memory_is_refused_before_it_does(
    grow: Callable[[Any], None], reason: str, board: Path
) -> None:
    def damage() -> None:
        values = json.loads((board / MINE).read_text(encoding="utf-8"))
        grow(values)
        (board / MINE).write_text(json.dumps(sealed(values)), encoding="utf-8")

    check_refused(board, damage, MINE, reason)


def test_all_that_is_refused_together_changes_no_number_of_the_table(
    board: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    show = importlib.import_module("clbench.leaderboard.cli").show
    honest = (board / MINE).read_text(encoding="utf-8")
    show(records=board)
    table = (board.parent / "site" / "leaderboard.csv").read_bytes()
    written_before = sorted(os.listdir(board.parent))
    edits = [*NAMES, *FIELDS, *ROWS]
    for number in range(len(edits) + len(FILES)):
        path = board / "Toy-v0" / f"theirs--mine{number}" / "seed-0.json"
        path.parent.mkdir()
        path.write_text(honest.replace("theirs/mine", f"theirs/mine{number}"), encoding="utf-8")
        if number < len(edits):
            values = json.loads(path.read_text(encoding="utf-8"))
            put(values, *edits[number][:2])
            path.write_text(json.dumps(sealed(values)), encoding="utf-8")
        else:
            FILES[number - len(edits)][0](path)
    show(records=board)
    page = (board.parent / "site" / "LEADERBOARD.md").read_text(encoding="utf-8")
    assert (board.parent / "site" / "leaderboard.csv").read_bytes() == table
    assert page.count("seed-0.json: ") == len(edits) + len(FILES)
    assert sorted(os.listdir(board.parent)) == sorted({*written_before, "elsewhere.json"})
    assert "<script>" not in page
    assert "\x1b" not in page + capsys.readouterr().out


@pytest.mark.parametrize("damage", [linked, piped, replaced_by_folder, written(b"{"), inflated])
def test_a_verification_that_is_none_is_not_waited_for(damage: Callable[[Path], Any], board: Path) -> None:
    before, _ = shown(board)
    path = (board / MINE).with_suffix(".verified")
    path.write_text("{}", encoding="utf-8")
    damage(path)
    after, refused = shown(board)
    assert list(after) == list(before)
    assert not refused


def test_a_linked_folder_is_listed_and_not_followed(board: Path, tmp_path: Path) -> None:
    before, _ = shown(board)
    (board / "Toy-v0" / "theirs--mine").rename(tmp_path / "outside")
    (board / "Toy-v0" / "theirs--mine").symlink_to(tmp_path / "outside")
    after, refused = shown(board)
    assert refused == {"Toy-v0/theirs--mine": "is a symbolic link, which is not followed."}
    assert list(after) == [path for path in before if path != MINE]


@pytest.mark.parametrize("count", [1, 5])
def test_records_of_strangers_do_not_outvote_built_in_methods(count: int, board: Path) -> None:
    """The simulator of the built-in methods' records is the board's, also against others' records."""
    values = json.loads((board / MINE).read_text(encoding="utf-8"))
    values["fingerprint"]["rollouts"] = {"toy:world": "4567"}
    for number in range(count):
        values["run"]["method"] = f"a{number}/mine"
        path = board / "Toy-v0" / f"a{number}--mine" / "seed-0.json"
        path.parent.mkdir()
        path.write_text(json.dumps(sealed(values)), encoding="utf-8")
    (board / "Toy-v0" / "sft" / "seed-1.json").unlink()
    before = ["Toy-v0/sft/seed-0.json", MINE, "Toy-v0/theirs--plain/seed-0.json"]
    after, refused = shown(board)
    assert list(after) == before
    assert len(refused) == count


@pytest.fixture
def traces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a module `evil_module` that leaves a file when it is imported, and return where."""
    (tmp_path / "code").mkdir()
    trace = tmp_path / "code" / "trace"
    code = f"open({str(trace)!r}, 'w').close()\nclass Evil: pass\n"
    (tmp_path / "code" / "evil_module.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path / "code")
    return trace


def test_nothing_that_a_record_names_is_imported(
    board: Path, traces: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    values = json.loads((board / MINE).read_text(encoding="utf-8"))
    values["run"]["method"] = "evil_module:Evil"
    values["fingerprint"]["rollouts"]["evil_module:Evil"] = "0123"
    values["diagnostics"] = {"1": {"evil_module:Evil": 1.0}}
    for folder, run in (
        ("records", {}),
        ("controls", {"changes": {"strength": 1}, "settings": {"strength": 1}}),
        ("tuning", {"split": "validation"}),
    ):
        changed = {**values, "run": {**values["run"], **run}}
        label = "evil_module.Evil" + ("+strength=1" if folder == "controls" else "")
        path = tmp_path / "leaderboard" / folder / "Toy-v0" / label / "seed-0.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(sealed(changed)), encoding="utf-8")
    importlib.import_module("clbench.leaderboard.cli").show()
    pages = importlib.import_module("clbench.leaderboard.pages.cli")
    pages.claims(scenario=SCENARIO)
    pages.method_pages(scenario=SCENARIO)
    assert not traces.exists()
    importlib.import_module("evil_module")
    assert traces.exists()
