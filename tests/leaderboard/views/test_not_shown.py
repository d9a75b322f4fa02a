"""Files that make no row: each is listed with its reason, and none hides another."""

import itertools
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from helpers import sealed, set_in

from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.pinned import pinned
from clbench.records.record import SCHEMA, Record
from clbench.records.writer import write_record

ASKS = {"demonstrations": "never", "questions": "prepare", "reference": False}
load = resolve("clbench:load_board")


def table_of_four_methods(records: Path, shown: Callable[[], Any]) -> bytes:
    """Return the CSV file of `records` as the fixture leaves them: each test has the same, made once."""
    if not _TABLE:
        shown()
        _TABLE.append((records.parent / "site" / "leaderboard.csv").read_bytes())
    return _TABLE[0]


_TABLE: list[bytes] = []


def flat(text: str) -> str:
    """Return `text` without the line breaks of the terminal and the backslashes of Markdown."""
    return " ".join(text.replace("\\", "").split())


@pytest.mark.long
def test_a_record_that_is_not_of_its_schema_is_listed_and_hides_no_other(
    four_methods: Path, add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    before = load(four_methods)
    path = add_full("old", 0)
    older = path.read_text(encoding="utf-8").replace(f'"schema": {SCHEMA}', '"schema": 2')
    path.write_text(older, encoding="utf-8")
    pandas.testing.assert_frame_equal(load(four_methods), before)
    for text in shown():
        assert "old/seed-0.json: run: order must be above 0 in schema 2" in flat(text)


def fail(record: Record) -> None:
    record.status = "failed"
    record.error = {"where": "loss", "type": "ValueError", "message": "no | [bold]way\n", "traceback": ""}


def lose(record: Record, lost: Callable[..., bool]) -> None:
    rows = [row for row in zip(*record.episodes.values(), strict=True) if not lost(*row)]
    record.episodes = {name: [row[n] for row in rows] for n, name in enumerate(record.episodes)}


def lose_curve_episode(record: Record) -> None:
    lose(record, lambda stage, step, task, split, episode, *_: 0 < step < 400 and episode == 9)


def lose_validation_episode(record: Record) -> None:
    lose(record, lambda stage, step, task, split, episode, *_: split == "validation" and episode == 9)


@pytest.mark.long
@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (fail, "the run failed (loss: ValueError: no | [bold]way"),
        (set_in("run", "changes", {"strength": 2}), "settings were changed: strength"),
        (set_in("run", "changes", 5), "run: changes must be an object with named entries, not 5."),
        (set_in("run", "method", "[red]x[/red] | `y` | <b>"), "cannot be the name of a method"),
        (set_in("run", "method", "x\n| best | 1.00 |"), "cannot be the name of a method"),
        (set_in("run", "method", "\x1b[31mred\u202e\ud800"), "cannot be the name of a method"),
        (set_in("run", "scenario", "../Toy\n"), "cannot be the id of a scenario"),
        (set_in("run", "scenario", "clbench/Toy-v9"), "was run"),
        (set_in("run", "uses", {}), "uses must say"),
        (
            lambda record: record.scenario.budget.update(adaptation_steps=9),
            "budget (adaptation_steps)",
        ),
        (set_in("scenario", "target", ["target_1", "target_0"]), "is missing at stage 1, step 100"),
        (set_in("fingerprint", "rollouts", {"toy:world": "4567"}), "rollouts of toy:world differ"),
        (set_in("fingerprint", "rollouts", None), "rollouts of all worlds differ"),
        (lose_curve_episode, "the test episode 9 of skill_0 (and 3 others) is missing at stage 1, step 100"),
        (lose_validation_episode, "the validation episode 9 of target_0 is missing at stage 1"),
        (
            set_in("run", "split", "validation"),
            "it is a tuning run: settings may have been chosen on its episodes.",
        ),
        (set_in("run", "settings", {"strength": 2}), "settings do not match most seeds: strength"),
        (set_in("run", "device", "cuda"), "settings do not match most seeds: device"),
    ],
)
def test_a_record_that_cannot_be_a_row_is_listed_with_its_reason_and_hides_no_other(
    edit: Callable[[Record], None],
    reason: str,
    four_methods: Path,
    add_full: Callable[..., Path],
    shown: Callable[[], tuple[str, str]],
) -> None:
    before = table_of_four_methods(four_methods, shown)
    add_full("asks", 2, edit=edit, uses=ASKS, place="Toy-v0/asks/seed-2.json")
    texts = shown()
    assert (four_methods.parent / "site" / "leaderboard.csv").read_bytes() == before
    for text in texts:
        assert "Toy-v0/asks/seed-2.json: " in flat(text)
        assert reason in flat(text)
        assert "Not shown" in text
        assert "\x1b" not in text
        assert "\n| best" not in text


def test_a_record_of_another_definition_than_most_of_a_strangers_scenario_is_not_shown(
    four_methods: Path, add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    rules: list[dict[str, str]] = [
        {},
        {},
        {},
        {"rule skill_0": "r"},
        {"rule skill_0": "r"},
        {"rule skill_0": "s"},
    ]
    for seed, rule in enumerate(rules):
        definition = {"task skill_0": "b" if seed == 2 else "a", "questions": "c", **rule}
        edit = set_in("fingerprint", "definition", definition)
        add_full("lora", seed, edit=edit, place=f"Toy-v0/lora/seed-{seed}.json")
    for text in shown():
        reason = "its definition of the scenario does not match most records:"
        assert f"Toy-v0/lora/seed-2.json: {reason} task skill_0 differ." in flat(text)
        assert f"Toy-v0/lora/seed-5.json: {reason} rule skill_0 differ." in flat(text)
        assert not any(f"Toy-v0/lora/seed-{seed}.json" in flat(text) for seed in (0, 1, 3, 4))


def test_a_record_of_another_definition_of_a_scenario_of_the_project_is_not_shown(
    four_methods: Path, add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    ours = pinned()["clbench/Fetch-v1"]
    for seed, definition in enumerate(
        (None, ours, {**ours, "task press": "0", "questions": "1"}, {"\x1b[2J": ""})
    ):
        edit = set_in("fingerprint", "definition", definition)
        add_full("sft", seed, edit=edit, scenario="clbench/Fetch-v1", place=f"Fetch-v1/sft/seed-{seed}.json")

    def on_arm(record: Record) -> None:
        record.fingerprint |= {"definition": {**ours, "task press": "0"}, "hardware": {"machine": "arm64"}}

    add_full("sft", 4, edit=on_arm, scenario="clbench/Fetch-v1", place="Fetch-v1/sft/seed-4.json")
    for text in shown():
        words = "fingerprint.definition must be an object, the parts of its scenario."
        assert f"Fetch-v1/sft/seed-0.json: a record of schema {SCHEMA}: {words}" in flat(text)
        assert "Fetch-v1/sft/seed-1.json" not in flat(text)
        words = "it was made with another definition of clbench/Fetch-v1"
        assert f"Fetch-v1/sft/seed-2.json: {words}: task press, questions differ." in flat(text)
        assert f"Fetch-v1/sft/seed-3.json: {words}: the tasks themselves differ." in flat(text)
        told = f"Fetch-v1/sft/seed-4.json: {words}: task press differ. Worlds move differently on arm64."
        assert told in flat(text)
        assert "\x1b" not in text


def test_records_that_are_all_of_arm_make_a_table_that_says_so(
    add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    ours = pinned()["clbench/Fetch-v1"]

    def on_arm(record: Record) -> None:
        moved = "1" if record.run.seed == 2 else "0"
        record.fingerprint |= {"definition": {**ours, "task press": moved}, "hardware": {"machine": "arm64"}}

    for seed in range(3):
        add_full(
            "sft", seed, edit=on_arm, scenario="clbench/Fetch-v1", place=f"Fetch-v1/sft/seed-{seed}.json"
        )
    for text in shown():
        assert (
            "All these records were made on arm64, where the simulators behave differently than on x86-64"
            in flat(text)
        )
        reason = "its definition of the scenario does not match most records: task press differ."
        assert f"Fetch-v1/sft/seed-2.json: {reason}" in flat(text)
        assert "Fetch-v1/sft/seed-1.json" not in flat(text)


def test_of_arm_records_only_what_episodes_show_may_differ_and_a_refused_record_hides_none(
    add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    ours = pinned()["clbench/Fetch-v1"]
    rule = next(name for name in ours if name.startswith("rule "))
    changes = [{"task press": "0"}, {"task press": "0", rule: "loose"}, {"task press": "1"}]
    machines = ["arm64", "arm64", "x86_64"]
    for seed, (changed, machine) in enumerate(zip(changes, machines, strict=True)):

        def edit(record: Record, changed: dict[str, str] = changed, machine: str = machine) -> None:
            record.fingerprint |= {"definition": {**ours, **changed}, "hardware": {"machine": machine}}

        add_full("sft", seed, edit=edit, scenario="clbench/Fetch-v1", place=f"Fetch-v1/sft/seed-{seed}.json")
    for text in shown():
        assert "All these records were made on arm64" in flat(text)
        words = "it was made with another definition of clbench/Fetch-v1"
        assert f"Fetch-v1/sft/seed-1.json: {words}: {rule} differ." in flat(text)
        assert f"Fetch-v1/sft/seed-2.json: {words}: task press differ." in flat(text)
        assert "Fetch-v1/sft/seed-0.json" not in flat(text)


def test_a_file_that_is_no_record_is_listed_and_hides_no_other(
    four_methods: Path, shown: Callable[[], tuple[str, str]]
) -> None:
    before = table_of_four_methods(four_methods, shown)
    contents = ["", "{", "[]", '{"a": 1}', '{"schema": 99}', "[" * 99_999, "\x00"]
    for number, content in enumerate(contents):
        (four_methods / f"a_torn_*file*{number}.json").write_text(content, encoding="utf-8")
    printed, page = shown()
    assert (four_methods.parent / "site" / "leaderboard.csv").read_bytes() == before
    for number in range(len(contents)):
        assert f"a_torn_*file*{number}.json: " in printed
        assert rf"a\_torn\_\*file\*{number}.json: " in page


def test_a_file_name_with_control_characters_is_shown_without_them(
    four_methods: Path, shown: Callable[[], tuple[str, str]]
) -> None:
    (four_methods / "x\n## y\x1b[31m.json").write_text("{", encoding="utf-8")
    (four_methods / os.fsdecode(b"\xff.json")).write_text("{", encoding="utf-8")
    for text in shown():
        assert "\x1b" not in text
        assert "\n## y" not in text


@pytest.mark.long
def test_a_record_in_another_place_is_refused_though_its_run_has_no_other(
    four_methods: Path, add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    before = load(four_methods)
    add_full("sft", 1, np.ones((3, 5)), place="a/copy.json")
    add_full("sft", 2, np.ones((3, 5)), place="a/more.json")
    pandas.testing.assert_frame_equal(load(four_methods), before)
    for text in shown():
        assert "a/copy.json: it belongs at Toy-v0/sft/seed-1.json in the folder of records." in flat(text)
        assert "a/more.json: it belongs at Toy-v0/sft/seed-2.json in the folder of records." in flat(text)


@pytest.mark.long
def test_any_damage_to_a_record_ends_in_a_row_or_a_reason(
    make_record: Callable[..., Record], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records = tmp_path / "records"
    whole_record = make_record(
        [[1.0, 0.0], [0.5, 1.0]], groups=(1, 1, 0), episodes=2, steps=(1, 2), sparsity=[[0.5, 0.4]]
    )
    path = record_path(records, "clbench/Toy-v0", "sft", 0)
    write_record(whole_record, path)
    whole = json.loads(path.read_text(encoding="utf-8"))
    damages: tuple[Any, ...] = (None, -1, 1e999, "x", [None], {"x": []}, 10**300)
    parts = {name: values for name, values in whole.items() if name != "schema"}
    places = [
        (name, key)
        for name, values in parts.items()
        for key in (None, *(values if isinstance(values, dict) else ()))
    ]
    places.remove(("run", "method"))
    for number, (damage, (field, key)) in enumerate(itertools.product(damages, places)):
        damaged = json.loads(json.dumps(whole))
        damaged["run"]["method"] = f"damaged_{number}"
        if key is None:
            damaged[field] = damage
        else:
            damaged[field][key] = damage
        damaged = damaged if field == "content" else sealed(damaged)
        text = json.dumps(damaged).replace("Infinity", "1e999")
        place = records / "Toy-v0" / f"damaged_{number}" / "seed-0.json"
        place.parent.mkdir()
        place.write_text(text, encoding="utf-8")
    rows = load(records)
    resolve("clbench.leaderboard.cli:show")(records=records)
    listed = re.findall(r"^  Toy-v0/damaged_\d+/seed-0\.json: ", capsys.readouterr().out, re.MULTILINE)
    assert "sft" in set(rows.method)
    assert len(rows) + len(listed) == 1 + len(damages) * len(places)
