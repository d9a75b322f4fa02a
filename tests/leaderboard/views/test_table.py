"""The leaderboard: the same records give the same bytes, and no file can hide another."""

import functools
import importlib
import itertools
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cyclopts
import numpy as np
import pandas
import pytest

from clbench.base.entry_points import resolve
from clbench.records.content import sealed
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.scoring.metrics import METRICS

ANSWERS = {(stage, kind): (50, 45 - 10 * stage) for stage in range(3) for kind in ("left", "above")}
VALIDATION = [[0.3, 0.6, 0.9, 0.9], [0.1, 0.3, 0.8, 0.8]]
REFERENCE = {"demonstrations": "never", "questions": "never", "reference": True}
REPLAY = {"demonstrations": "throughout", "questions": "never", "reference": False}
ASKS = {"demonstrations": "never", "questions": "prepare", "reference": False}


def load(records: Path) -> pandas.DataFrame:
    frame = importlib.import_module("clbench.leaderboard").load(records)
    assert isinstance(frame, pandas.DataFrame)
    return frame


@pytest.fixture
def add(add: Callable[..., Path]) -> Callable[..., Path]:
    """Return the function that adds a record, for one with values for every metric."""
    policy = {"sparsity": np.full((2, 4), 0.6), "drift": np.full((2, 4), 3.0)}
    return functools.partial(add, validation=VALIDATION, answers=ANSWERS, **policy)


@pytest.fixture
def records(add: Callable[..., Path], matrix: Any, tmp_path: Path) -> Path:
    """Return a folder with the records of four methods."""
    for seed in range(2):
        add("sft", seed)
        add("replay", seed, np.clip(matrix + 0.3, 0, 1), uses=REPLAY)
        add("asks", seed, uses=ASKS)
        add("from_scratch", seed, uses=REFERENCE)
    return tmp_path / "leaderboard" / "records"


@pytest.fixture
def shown_with_page(records: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[], tuple[str, str]]:
    """Return a function that shows the leaderboard and returns what is printed and the Markdown."""

    def shown() -> tuple[str, str]:
        resolve("clbench.leaderboard.cli:show")(records=records)
        return capsys.readouterr().out, (records.parent / "site" / "LEADERBOARD.md").read_text(
            encoding="utf-8"
        )

    return shown


@pytest.fixture
def shown(
    shown_with_page: Callable[[], tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> Callable[[], tuple[str, str]]:
    """Return the same without the HTML page and its pictures, which take most of the time."""
    monkeypatch.setattr("clbench.leaderboard.views.page.page", lambda _: "")
    monkeypatch.setattr("clbench.leaderboard.views.page.pictures", lambda _: {})
    return shown_with_page


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


def test_there_is_one_row_for_each_method_sorted_by_division_and_final_average(
    records: Path, add: Callable[..., Path]
) -> None:
    add("better", 0, np.ones((3, 5)))
    frame = load(records)
    assert list(frame.method) == ["better", "sft", "asks", "replay", "from_scratch"]
    assert list(frame.division) == [
        "prior-data-free",
        "prior-data-free",
        "prior questions",
        "prior demonstrations",
        "reference",
    ]
    assert list(frame.seeds) == [1, 2, 2, 2, 2]


def test_a_row_has_every_metric_with_its_interval_and_the_costs(records: Path) -> None:
    row = load(records).set_index("method").loc["sft"]
    assert row.retention == pytest.approx(0.45)
    assert row.forgetting == pytest.approx(1.6 / 3)
    assert row.question_retention == pytest.approx(0.5)
    assert row.retention_at_matched_adaptation == pytest.approx(0.7)
    assert row.update_sparsity == pytest.approx(0.6)
    assert row.activation_drift == pytest.approx(3.0)
    assert row.steps == 800
    assert row.parameters == 1000
    assert np.isnan(row.intransigence)  # there is no joint
    assert np.isnan(row.perturbed_retention)
    for name in set(METRICS) - {"intransigence", "perturbed_retention"}:
        assert row[f"{name}_low"] <= row[name] <= row[f"{name}_high"]


def test_without_from_scratch_forward_transfer_is_missing(records: Path) -> None:
    assert load(records).set_index("method").forward_transfer.notna().sum() == 3
    record_path(records, "clbench/Toy-v0", "from_scratch", 1).unlink()
    assert load(records).forward_transfer.isna().all()


def test_without_plain_fine_tuning_matched_retention_is_missing(records: Path) -> None:
    assert load(records).retention_at_matched_adaptation.notna().all()
    record_path(records, "clbench/Toy-v0", "sft", 1).unlink()
    rows = load(records).set_index("method")
    assert rows.retention_at_matched_adaptation.dropna().index.tolist() == ["sft"]


def test_a_method_that_does_not_learn_as_well_as_plain_fine_tuning_has_no_matched_retention(
    records: Path, add: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    add("slow", 0, validation=np.array(VALIDATION) / 2)
    assert np.isnan(load(records).set_index("method").retention_at_matched_adaptation["slow"])
    _, page = shown()
    assert "**matched retention** (higher is better; from 0 to 1; version 0)" in page


def test_a_record_that_is_not_of_its_schema_is_listed_and_hides_no_other(
    records: Path, add: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    before = load(records)
    path = add("old", 0)
    path.write_text(path.read_text(encoding="utf-8").replace('"schema": 3', '"schema": 1'), encoding="utf-8")
    pandas.testing.assert_frame_equal(load(records), before)
    for text in shown():
        assert "old/seed-0.json: a record: schema 1 has no policy" in flat(text)


def test_a_row_does_not_depend_on_the_other_rows(records: Path, add: Callable[..., Path]) -> None:
    before = load(records)
    add("another", 0)
    add("sft", 0, scenario="clbench/Other-v0")
    after = load(records)
    kept = after[(after.scenario == "clbench/Toy-v0") & (after.method != "another")]
    kept = kept.reset_index(drop=True).drop(columns="rank")
    pandas.testing.assert_frame_equal(kept, before.drop(columns="rank"))


def test_showing_twice_changes_no_byte_and_writes_no_file_again(
    records: Path, shown_with_page: Callable[[], tuple[str, str]]
) -> None:
    (records / "torn.json").write_text("{", encoding="utf-8")
    first = shown_with_page()
    files = [records.parent / "site" / name for name in ("LEADERBOARD.md", "leaderboard.csv")]
    stamps = [(path.read_bytes(), path.stat().st_mtime_ns, path.stat().st_ino) for path in files]
    assert shown_with_page() == first
    assert [(path.read_bytes(), path.stat().st_mtime_ns, path.stat().st_ino) for path in files] == stamps
    made = ["LEADERBOARD.md", "index.html", "leaderboard.csv", "pareto-dark.svg", "pareto.svg"]
    assert sorted(os.listdir(records.parent)) == ["records", "site"]
    assert sorted(os.listdir(records.parent / "site")) == made


def test_the_files_do_not_depend_on_where_the_records_lie(
    records: Path, shown: Callable[[], tuple[str, str]], tmp_path: Path
) -> None:
    (records / "folder.json").mkdir()
    (records / "torn.json").write_text("{", encoding="utf-8")
    _, here = shown()
    table = (records.parent / "site" / "leaderboard.csv").read_bytes()
    (tmp_path / "elsewhere").mkdir()
    moved = records.rename(tmp_path / "elsewhere" / "records")
    resolve("clbench.leaderboard.cli:show")(records=moved)
    assert (moved.parent / "site" / "LEADERBOARD.md").read_text(encoding="utf-8") == here
    assert (moved.parent / "site" / "leaderboard.csv").read_bytes() == table
    assert str(tmp_path) not in here


def test_the_markdown_has_values_with_intervals_and_says_what_they_are(
    shown: Callable[[], tuple[str, str]],
) -> None:
    _, page = shown()
    row = next(line for line in page.splitlines() if line.startswith("| 1 | sft |"))
    assert "| prior-data-free | self-reported | 2 | 0.50 [0." in row
    assert "**forgetting** (lower is better" in page
    assert "## clbench/Toy-v0" in page
    assert "Not shown" not in page
    assert len({line.count("|") for line in page.splitlines() if line.startswith("|")}) == 1


PERTURBED = [[0.9, 0.8], [0.5, 0.7], [0.4, 0.2]]


def test_perturbed_retention_stands_beside_retention_where_a_row_has_it(
    records: Path, add: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    before, (_, page) = load(records), shown()
    assert "perturbed retention" not in page
    for seed in range(2):
        add("sft", seed, perturbed=PERTURBED)
    add("asks", 1, uses=ASKS, perturbed=PERTURBED)  # one of its two seeds alone
    after, (_, page) = load(records), shown()
    head = next(line for line in page.splitlines() if line.startswith("| rank |"))
    place = [cell.strip() for cell in head.split("|")].index("perturbed retention")
    assert head.split("|")[place - 1].strip() == "retention"
    cells = {
        method: next(line for line in page.splitlines() if f"| {method} |" in line).split("|")[place].strip()
        for method in ("sft", "asks", "replay")
    }
    assert cells["sft"].startswith("0.30 [")
    assert (cells["asks"], cells["replay"]) == ("-", "-")
    assert "**perturbed retention** (higher is better" in page
    changed = [f"perturbed_retention{end}" for end in ("", "_low", "_high")]
    pandas.testing.assert_frame_equal(after.drop(columns=changed), before.drop(columns=changed))
    assert before.perturbed_retention.isna().all()
    assert after.set_index("method").perturbed_retention["sft"] == pytest.approx(0.3)


def test_what_is_missing_is_a_dash_in_markdown_and_empty_in_csv(
    records: Path, shown: Callable[[], tuple[str, str]]
) -> None:
    _, page = shown()
    assert " | - | " in next(line for line in page.splitlines() if line.startswith("| - | from\\_scratch |"))
    frame = pandas.read_csv(records.parent / "site" / "leaderboard.csv")
    assert frame.set_index("method").forward_transfer.isna().to_dict() == {
        "sft": False,
        "asks": False,
        "replay": False,
        "from_scratch": True,
    }


def test_the_csv_file_is_the_data_frame(records: Path, shown: Callable[[], tuple[str, str]]) -> None:
    shown()
    written = pandas.read_csv(records.parent / "site" / "leaderboard.csv")
    pandas.testing.assert_frame_equal(written, load(records), check_dtype=False, atol=6e-5, rtol=0)


def test_the_terminal_shows_all_rows_in_108_columns(
    add: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    add("experience_replay", 0)
    printed, _ = shown()
    table, _, _ = printed.partition("Written: ")  # the paths below it are as long as they are
    assert max(map(len, table.splitlines())) <= 108
    for word in ("experience_replay", "from_scratch", "prior demonstrations", "reference", "0.45±."):
        assert word in printed
    row = next(line for line in printed.splitlines() if "experience_replay" in line)
    assert len(row.split()) == 3 + 6 + 3  # rank, name, seeds; six metrics; cost, bytes and tier: none cut off
    assert "matched" in printed
    assert "…" not in printed


def test_bytes_have_three_digits_and_go_on_to_the_next_unit(
    records: Path, add: Callable[..., Path], shown_with_page: Callable[[], tuple[str, str]]
) -> None:
    counts = {0: "0", 999: "999", 1234: "1.23k", 999_900: "1M", 45_678_901: "45.7M", 3 * 10**15: "3000T"}
    for number, count in enumerate(counts):
        add(f"size_{number}", 0, edit=set_in("costs", "bytes_kept", count))
    printed = [line.split() for line in shown_with_page()[0].splitlines()]
    page = (records.parent / "site" / "index.html").read_text(encoding="utf-8")
    for number, (count, text) in enumerate(counts.items()):
        (size,) = (line[-2] for line in printed if f"size_{number}" in line)
        assert size == text
        unit = f" {text[-1]}B" if text[-1].isalpha() else ""
        assert f'<span title="{count:,} bytes">{text.rstrip("kMGT")}{unit}</span>' in page


def test_the_relative_cost_is_that_of_all_steps_with_the_time_of_one(
    records: Path, add: Callable[..., Path]
) -> None:
    for seed in range(2):
        add("sft", seed, edit=set_in("costs", "optimiser_steps", 400))
        add("slow", seed, edit=set_in("costs", "optimiser_steps", 600))
        add("unknown", seed, edit=set_in("costs", "optimiser_steps", 400))
        add("idle", seed, edit=set_in("costs", "optimiser_steps", 0))
    assert load(records).relative_cost.isna().sum() == len(load(records)) - 1
    ratios = {name: {"median_ratio": ratio} for name, ratio in (("sft", 1.0), ("slow", 1.4))}
    path = records.parents[1] / "benchmarks" / "results" / "step_time.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"ratios": ratios}), encoding="utf-8")
    costs = load(records).set_index("method").relative_cost
    assert costs["sft"] == 1.0
    assert costs["slow"] == pytest.approx(1.5 * 1.4)
    assert costs["idle"] == 0.0
    assert np.isnan(costs["unknown"])


def test_rows_in_every_scenario_are_averaged_over_them(
    records: Path, add: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    assert all("All scenarios" not in text for text in shown())
    for seed in range(2):
        add("sft", seed, np.zeros((3, 5)), scenario="clbench/Other-v0")
        add("elsewhere", seed, scenario="clbench/Other-v0")
    printed, page = shown()
    assert "All scenarios" in printed
    section = page.partition("## All scenarios")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ") and "division" not in line]
    (row,) = [line for line in rows if "---" not in line]
    frame = load(records)
    here = frame[(frame.scenario == "clbench/Toy-v0") & (frame.method == "sft")].iloc[0]
    there = frame[(frame.scenario == "clbench/Other-v0") & (frame.method == "sft")].iloc[0]
    assert there.final_average == 0.0
    mean = here.final_average / 2
    low = mean - np.hypot(here.final_average - here.final_average_low, 0.0) / 2
    assert row.startswith("| sft | prior-data-free | 1, 1 | ")
    assert f"| {mean:.2f} [{low:.2f}, " in row


def set_in(name: str, key: str, value: Any) -> Callable[[Record], None]:
    def edit(record: Record) -> None:
        part = getattr(record, name)
        if isinstance(part, dict):
            part[key] = value
        else:
            setattr(part, key, value)

    return edit


def fail(record: Record) -> None:
    record.status = "failed"
    record.error = {"where": "loss", "type": "ValueError", "message": "no | [bold]way\n", "traceback": ""}


def cut_answers(record: Record) -> None:
    record.answers = {name: column[:-1] for name, column in record.answers.items()}
    record.answers["kind"][-1] = "right"


def lose(record: Record, lost: Callable[..., bool]) -> None:
    rows = [row for row in zip(*record.episodes.values(), strict=True) if not lost(*row)]
    record.episodes = {name: [row[n] for row in rows] for n, name in enumerate(record.episodes)}


def lose_curve_episode(record: Record) -> None:
    lose(record, lambda stage, step, task, split, episode, *_: 0 < step < 400 and episode == 9)


def lose_validation_episode(record: Record) -> None:
    lose(record, lambda stage, step, task, split, episode, *_: split == "validation" and episode == 9)


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (fail, "the run failed (loss: ValueError: no | [bold]way"),
        (set_in("run", "changes", {"strength": 2}), "settings were changed: strength"),
        (set_in("run", "changes", 5), "run: changes must be an object with named entries, not 5."),
        (set_in("run", "method", "[red]x[/red] | `y` | <b>"), "cannot be the name of a method"),
        (set_in("run", "method", "x\n| best | 1.00 |"), "cannot be the name of a method"),
        (set_in("run", "method", "\x1b[31mred\u202e\ud800"), "cannot be the name of a method"),
        (set_in("run", "method", None), "run: method must be a text, not null."),
        (set_in("run", "scenario", "../Toy\n"), "cannot be the id of a scenario"),
        (set_in("run", "scenario", "clbench/Toy-v9"), "was run"),
        (set_in("run", "seed", "0"), 'run: seed must be a whole number, not "0".'),
        (set_in("run", "uses", {}), "uses must say"),
        (set_in("scenario", "retained", "all"), 'scenario: retained must be a list, not "all".'),
        (
            lambda record: record.scenario.budget.update(adaptation_steps=9),
            "budget (adaptation_steps)",
        ),
        (set_in("scenario", "target", ["target_1", "target_0"]), "target differ"),
        (set_in("fingerprint", "rollouts", {"toy:world": "4567"}), "rollouts of toy:world differ"),
        (set_in("fingerprint", "rollouts", None), "rollouts of all worlds differ"),
        (set_in("episodes", "success", [0.5]), "different lengths"),
        (cut_answers, "kinds differ"),
        (lose_curve_episode, "curve_episodes differ"),
        (lose_validation_episode, "validation_episodes differ"),
        (set_in("policy", "step", []), "the columns of policy have different lengths"),
        (set_in("run", "split", "validation"), "it is a tuning run: its episodes may be chosen on."),
        (set_in("run", "split", "all"), "split must be test or validation"),
        (set_in("run", "settings", {"strength": 2}), "settings are not those of most seeds: strength"),
        (set_in("run", "device", "cuda"), "settings are not those of most seeds: device"),
    ],
)
def test_a_record_that_cannot_be_a_row_is_listed_with_its_reason_and_hides_no_other(
    edit: Callable[[Record], None],
    reason: str,
    records: Path,
    add: Callable[..., Path],
    shown: Callable[[], tuple[str, str]],
) -> None:
    before = table_of_four_methods(records, shown)
    add("asks", 2, edit=edit, uses=ASKS, place="Toy-v0/asks/seed-2.json")
    texts = shown()
    assert (records.parent / "site" / "leaderboard.csv").read_bytes() == before
    for text in texts:
        assert "Toy-v0/asks/seed-2.json: " in flat(text)
        assert reason in flat(text)
        assert "Not shown" in text
        assert "\x1b" not in text
        assert "\n| best" not in text


@pytest.mark.parametrize("content", ["", "{", "[]", '{"a": 1}', '{"schema": 99}', "[" * 99_999, "\x00"])
def test_a_file_that_is_no_record_is_listed_and_hides_no_other(
    content: str, records: Path, shown: Callable[[], tuple[str, str]]
) -> None:
    before = table_of_four_methods(records, shown)
    (records / "a_torn_*file*.json").write_text(content, encoding="utf-8")
    printed, page = shown()
    assert (records.parent / "site" / "leaderboard.csv").read_bytes() == before
    assert "a_torn_*file*.json: " in printed
    assert r"a\_torn\_\*file\*.json: " in page


def test_a_file_name_with_control_characters_is_shown_without_them(
    records: Path, shown: Callable[[], tuple[str, str]]
) -> None:
    (records / "x\n## y\x1b[31m.json").write_text("{", encoding="utf-8")
    (records / os.fsdecode(b"\xff.json")).write_text("{", encoding="utf-8")
    for text in shown():
        assert "\x1b" not in text
        assert "\n## y" not in text


def test_a_record_that_lies_elsewhere_is_refused_though_its_run_has_no_other(
    records: Path, add: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    before = load(records)
    add("sft", 1, np.ones((3, 5)), place="a/copy.json")
    add("sft", 2, np.ones((3, 5)), place="a/more.json")
    pandas.testing.assert_frame_equal(load(records), before)
    for text in shown():
        assert "a/copy.json: it is the record of Toy-v0/sft/seed-1.json, and must lie there." in flat(text)
        assert "a/more.json: it is the record of Toy-v0/sft/seed-2.json, and must lie there." in flat(text)


def test_hostile_task_names_are_refused(
    add: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    def rename(record: Record) -> None:
        name = "x\n## y <b>\ud800"
        record.scenario.retained[0] = name
        tasks = record.episodes["task"]
        record.episodes["task"] = [name if task == "skill_0" else task for task in tasks]

    add("sft", 0, scenario="strange/Toy-v0", edit=rename)
    _, page = shown()
    assert "## strange/Toy-v0" not in page
    assert r"'x\\n\#\# y \<b\>\\ud800' cannot be the name of a task" in page


def test_web_addresses_of_strangers_are_no_links(
    add: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    add("sft", 7, edit=set_in("run", "changes", {"https://x.example www.x.example": 1}))
    _, page = shown()
    assert "://" not in page
    assert "www." not in page


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


def test_a_folder_without_rows_lists_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "torn.json").write_text("{", encoding="utf-8")
    resolve("clbench.leaderboard.cli:show")(records=tmp_path / "records")
    assert "torn.json: cannot be read as JSON" in capsys.readouterr().out
    assert load(tmp_path / "records").empty
    assert "retention_low" in load(tmp_path / "records")


@pytest.mark.parametrize("exists", [True, False])
def test_without_records_the_command_says_what_to_run(
    exists: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "records"
    if exists:
        folder.mkdir()
    with pytest.raises(SystemExit) as exit_info:
        resolve("clbench.leaderboard.cli:show")(records=folder)
    assert exit_info.value.code == 2
    captured = capsys.readouterr()
    assert not captured.out
    assert str(folder) in captured.err
    assert "clbench run clbench/Fetch-v0 sft" in captured.err
    assert not (tmp_path / "LEADERBOARD.md").exists()


def test_loading_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load(tmp_path / "nowhere")


def test_the_command_takes_the_folder_as_an_option(records: Path, capsys: pytest.CaptureFixture[str]) -> None:
    app = cyclopts.App(result_action="return_value")
    app.command(resolve("clbench.leaderboard.cli:show"), name="leaderboard")
    app(["leaderboard", "--records", str(records)])
    assert "from_scratch" in capsys.readouterr().out
