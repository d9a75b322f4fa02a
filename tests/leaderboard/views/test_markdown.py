"""The leaderboard as Markdown: its contents, and strangers' words without markup."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas
import pytest
from helpers import set_in

from clbench.base.entry_points import resolve
from clbench.records.record import Record
from clbench.scoring.intervals import Estimate

VALIDATION = [[0.3, 0.6, 0.9, 0.9], [0.1, 0.3, 0.8, 0.8]]
ASKS = {"demonstrations": "never", "questions": "prepare", "reference": False}
PERTURBED = [[0.9, 0.8], [0.5, 0.7], [0.4, 0.2]]
load = resolve("clbench:load_board")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
markdown = resolve("clbench.leaderboard.views.markdown:markdown")
TiedGain = resolve("clbench.leaderboard.board.certainty:TiedGain")


def test_the_markdown_has_values_with_intervals_and_explains_them(
    shown: Callable[[], tuple[str, str]],
) -> None:
    _, page = shown()
    row = next(line for line in page.splitlines() if "| sft |" in line)
    assert "| prior-data-free | self-reported | 2 | 0.50 [0." in row
    assert "**forgetting** (lower is better" in page
    assert "## clbench/Toy-v0" in page
    assert "Not shown" not in page
    assert len({line.count("|") for line in page.splitlines() if line.startswith("|")}) == 1


@pytest.mark.long
def test_perturbed_retention_follows_retention_where_a_row_has_it(
    four_methods: Path, add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    before, (_, page) = load(four_methods), shown()
    assert "perturbed retention" not in page
    for seed in range(2):
        add_full("sft", seed, perturbed=PERTURBED)
    add_full("asks", 1, uses=ASKS, perturbed=PERTURBED)  # one of its two seeds alone
    after, (_, page) = load(four_methods), shown()
    head = next(line for line in page.splitlines() if line.startswith("| letters |"))
    place = [cell.strip() for cell in head.split("|")].index("perturbed retention")
    assert head.split("|")[place - 1].strip() == "retention"
    cells = {
        method: next(line for line in page.splitlines() if f"| {method} |" in line).split("|")[place].strip()
        for method in ("sft", "asks", "replay")
    }
    assert cells["sft"].startswith("0.30 [")
    assert (cells["asks"], cells["replay"]) == ("-", "-")
    assert "**perturbed retention** (higher is better" in page
    names = ("perturbed_retention", "perturbed_adaptation")
    changed = [f"{name}{end}" for name in names for end in ("", "_low", "_high")]
    pandas.testing.assert_frame_equal(after.drop(columns=changed), before.drop(columns=changed))
    assert before.perturbed_retention.isna().all()
    assert after.set_index("method").perturbed_retention["sft"] == pytest.approx(0.3)


@pytest.mark.long
def test_a_missing_value_is_a_dash_in_markdown_and_empty_in_csv(
    four_methods: Path, shown: Callable[[], tuple[str, str]]
) -> None:
    _, page = shown()
    assert " | - | " in next(line for line in page.splitlines() if line.startswith("| - | from\\_scratch |"))
    frame = pandas.read_csv(four_methods.parent / "site" / "leaderboard.csv")
    assert frame.set_index("method").forward_transfer.isna().to_dict() == {
        "sft": False,
        "asks": False,
        "replay": False,
        "from_scratch": True,
    }


@pytest.mark.long
def test_two_scenarios_with_rivals_make_a_table_of_final_averages(
    four_methods: Path, add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    for seed in range(2):
        add_full("sft", seed, np.zeros((3, 5)), scenario="clbench/Other-v0")
    assert all("All scenarios" not in text for text in shown())  # sft has no rival there
    for seed in range(2):
        add_full("elsewhere", seed, scenario="clbench/Other-v0")
    printed, page = shown()
    assert "All scenarios: final average" in printed
    section = page.partition("## All scenarios")[2].partition("\n## ")[0]
    lines = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    assert lines[0] == ["method", "division", "Other-v0", "Toy-v0"]
    cells = {method: numbers for method, _, *numbers in lines[2:]}
    here = load(four_methods).set_index(["scenario", "method"]).loc[("clbench/Toy-v0", "sft")]
    low, high = here.final_average_low, here.final_average_high
    assert cells["sft"] == ["0.00 [0.00, 0.00]", f"{here.final_average:.2f} [{low:.2f}, {high:.2f}]"]
    assert cells["elsewhere"][1] == cells["asks"][0] == "-"
    shown_rows = [line.split() for line in printed.partition("All scenarios")[2].splitlines()]
    assert ["elsewhere", "-"] in [line[::2] for line in shown_rows if len(line) == 3]


def test_hostile_task_names_are_refused(
    add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    def rename(record: Record) -> None:
        name = "x\n## y <b>\ud800"
        record.scenario.retained[0] = name
        tasks = record.episodes["task"]
        record.episodes["task"] = [name if task == "skill_0" else task for task in tasks]

    add_full("sft", 0, scenario="strange/Toy-v0", edit=rename)
    _, page = shown()
    assert "## strange/Toy-v0" not in page
    assert r"'x\\n\#\# y \<b\>\\ud800' cannot be the name of a task" in page


def test_web_addresses_of_strangers_are_no_links(
    add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    add_full("sft", 7, edit=set_in("run", "changes", {"https://x.example www.x.example": 1}))
    _, page = shown()
    assert "://" not in page
    assert "www." not in page


def test_a_formula_of_a_stranger_is_no_formula(
    add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    add_full("sft", 7, edit=set_in("run", "changes", {"$x$": 1}))
    _, page = shown()
    assert r"\$x\$" in page


def test_a_gain_that_another_setting_of_plain_fine_tuning_takes_back_is_told_below_the_table(
    even_board: Callable[..., Path],
) -> None:
    for seed in range(4):
        even_board("sft", seed, 0.1)
        records = even_board("lora", seed, 0.9)
    board = compute_board(records)
    tied = {"lora": (TiedGain(0.1, Estimate(0.007, -0.016, 0.03), 4),)}
    assert "is not certain: it is" not in markdown(board, {})
    assert (
        "but 0.007 [-0.016, 0.030] at 0.1 times the scenario's learning rate, which scored the same in "
        "tuning (4 seeds)."
    ) in markdown(dataclasses.replace(board, tied={"clbench/Even-v1": tied}), {}).replace("\\", "")
    tied = {"lora": (TiedGain(0.1, Estimate(None, None, None), 0),)}
    assert (
        "but 0.1 times the scenario's learning rate scored the same in tuning, and the ladder beside these "
        "records has no runs of it"
    ) in markdown(dataclasses.replace(board, tied={"clbench/Even-v1": tied}), {}).replace("\\", "")
