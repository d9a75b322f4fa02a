"""Scenarios whose stages end when the target is learned: their columns, and the ladder of learning rates."""

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import html5lib
import pytest
from helpers import unpacked

from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import record_text

SCENARIO = "clbench/Even-v1"
page = resolve("clbench.leaderboard.views.page:page")
pictures = resolve("clbench.leaderboard.views.page:pictures")
markdown = resolve("clbench.leaderboard.views.markdown:markdown")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
show = resolve("clbench.leaderboard.cli:show")


@pytest.fixture
def records(even_board: Callable[..., Path]) -> Path:
    """Return a folder of records of three methods with four seeds, beside a ladder of two."""
    for seed in range(4):
        for method, kept in (("sft", 0.1), ("finch", 0.5), ("lora", 0.3)):
            even_board(method, seed, kept)
    for factor, kept in ((0.1, 0.4), (1.0, 0.2)):
        for seed in range(2):
            even_board("finch", seed, kept + 0.3, "ladder", step_factor=factor)
            even_board("sft", seed, kept, "ladder", step_factor=factor)
    return even_board("lora", 0, 0.3)


def words(element: ElementTree.Element) -> str:
    return " ".join(" ".join(element.itertext()).split())


def section_of(records: Path) -> ElementTree.Element:
    document = html5lib.HTMLParser(strict=True, namespaceHTMLElements=False).parse(
        page(compute_board(records), {})
    )
    found: ElementTree.Element
    (found,) = (one for one in document.iter() if one.get("id") == SCENARIO)
    return found


def test_the_curves_have_the_seeds_that_all_rungs_have(
    records: Path, even_board: Callable[..., Path]
) -> None:
    even_board("sft", 3, 1.0, "ladder", step_factor=0.1)
    curves = compute_board(records).frontiers[SCENARIO]
    assert [(curve.method, {rung.seeds for rung in curve.rungs}) for curve in curves] == [
        ("sft", {(0, 1)}),
        ("finch", {(0, 1)}),
    ]


@pytest.mark.long
def test_scenarios_with_a_criterion_come_first(records: Path, make_record: Callable[..., Record]) -> None:
    fixed = "clbench/Alphabetic-v0"
    path = record_path(records, fixed, "sft", 0)
    path.parent.mkdir(parents=True)
    path.write_text(
        record_text(make_record([[1, 0], [1, 1]], scenario=fixed, groups=(1, 1, 0))), encoding="utf-8"
    )
    rows = compute_board(records).rows
    assert list(dict.fromkeys(row.scenario for row in rows)) == [SCENARIO, fixed]


@pytest.mark.long
def test_a_scenario_with_a_criterion_has_its_own_columns(records: Path) -> None:
    head = next(
        line for line in markdown(compute_board(records), {}).splitlines() if line.startswith("| letters")
    )
    columns = [cell.strip() for cell in head.strip("|").split("|")][5:]
    assert columns[:6] == ["final average", "gain", "learned", "kept skills", "kept targets", "kept"]
    assert columns[6:9] == ["kept share", "criterion met", "steps to criterion"]
    heads = [words(one) for one in section_of(records).iterfind(".//table/thead/tr/th")]
    assert "settings tried" in heads
    assert "gain" in heads
    assert "retention" not in heads


@pytest.mark.long
def test_the_terminal_shows_gain_and_kept(
    records: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "108")
    show(records=records)
    lines = capsys.readouterr().out.partition("Written")[0].splitlines()
    assert max(map(len, lines)) <= 108
    row = next(line.split() for line in lines if " finch " in line)
    assert row[3].startswith("0.60±")  # skills and first target at .5, the last at .9
    assert row[4].startswith("+0.30±")  # sft: skills and first target at .1
    assert row[-4:] == ["-", "-", "0", "0"]


def test_settings_tried_are_counted(records: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tuned = resolve("clbench.runs.tuning:Tuned")({}, (None,) * 6)
    monkeypatch.setattr("clbench.leaderboard.board.rows.tuned", lambda _: {"finch": tuned})
    text = markdown(compute_board(records), {})
    assert "| 6 | - |" in next(line for line in text.splitlines() if "| finch | prior" in line)
    assert "| - | - |" in next(line for line in text.splitlines() if "| lora | prior" in line)


@pytest.mark.long
def test_seeds_that_order_the_methods_alike_are_said_to_do_so(
    records: Path, even_board: Callable[..., Path]
) -> None:
    for seed in range(4):
        for method, kept in (("l2_sp", 0.6), ("stop_gradient", 0.2), ("aegis", 0.1)):
            even_board(method, seed, kept)
    sentence = (
        "The 4 seeds agree on the order of the 6 methods (without controls) more than chance would explain: "
        "Kendall's W 1.00, p = 0.0012."
    )
    assert sentence in words(section_of(records))
    assert sentence in markdown(compute_board(records), {}).replace("\\", "")


@pytest.mark.long
def test_targets_of_balanced_seeds_are_numbered_in_the_section_of_a_row(records: Path) -> None:
    assert "new tasks, each seed in its own order target_ 0 target_ 1" in words(section_of(records))
    assert "after target 2" in unpacked(page(compute_board(records), {}))


@pytest.mark.long
def test_the_frontier_has_each_method_at_each_learning_rate(records: Path) -> None:
    curves = compute_board(records).frontiers[SCENARIO]
    assert [curve.method for curve in curves] == ["sft", "finch"]
    assert [(rung.factor, rung.kept.value, len(rung.seeds)) for rung in curves[1].rungs] == [
        (1.0, pytest.approx(0.5), 2),
        (0.1, pytest.approx(0.7), 2),
    ]
    assert "| finch | 0.1 | 0.90 [" in markdown(compute_board(records), {})
    section = section_of(records)
    assert section.find(".//figure[@data-frontier]") is not None
    assert "\N{MULTIPLICATION SIGN} 0.1 0.90 [" in words(section)
    drawn = pictures(compute_board(records))
    assert {"frontier-Even-v1.svg", "frontier-Even-v1-dark.svg"} < set(drawn)
    for picture in drawn.values():
        assert "var(" not in picture


def test_without_a_ladder_there_is_no_frontier(even_board: Callable[..., Path]) -> None:
    table = compute_board(even_board("sft", 0, 0.2))
    assert not table.frontiers
    assert "frontier" not in markdown(table, {})
    assert set(pictures(table)) == {"pareto.svg", "pareto-dark.svg"}


def test_a_ladder_record_without_a_learning_rate_is_refused(even_board: Callable[..., Path]) -> None:
    even_board("finch", 0, 0.4, "ladder", kappa=0.5)
    table = compute_board(even_board("sft", 0, 0.2))
    assert not table.frontiers
    (entry,) = table.not_shown
    assert entry.path.startswith("ladder/Even-v1/finch+kappa=0.5/")
    assert "step_factor" in entry.reason
