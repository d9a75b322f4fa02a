"""The page: all that is behind the numbers, in one file, the same bytes from the same records."""

import dataclasses
import hashlib
import importlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import html5lib
import numpy as np
import pytest
from helpers import data_of

from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record

page = resolve("clbench.leaderboard.views.page:page")
pictures = resolve("clbench.leaderboard.views.page:pictures")
markdown = resolve("clbench.leaderboard.views.markdown:markdown")
format_interval = resolve("clbench.leaderboard.views.format:format_interval")
tiers = importlib.import_module("clbench.leaderboard.board.tiers")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")

HOSTILE = "</script><img src=x onerror=alert(1)>'\"&{{ 1 }}"
ADDRESS = re.compile(r"https?://[^\s\"'<>`)\\]+")


@pytest.fixture
def records(add: Callable[..., Path], matrix: Any, tmp_path: Path) -> Path:
    """Return a folder with the records of two methods."""
    for seed in range(2):
        add("sft", seed)
        add("better", seed, np.clip(matrix + 0.3, 0, 1))
    return tmp_path / "leaderboard" / "records"


def parsed(text: str) -> ElementTree.Element:
    """Return the document of a page that has no error."""
    parser = html5lib.HTMLParser(strict=True, namespaceHTMLElements=False)
    document: ElementTree.Element = parser.parse(text)
    return document


def words(element: ElementTree.Element) -> str:
    """Return the text of an element, its parts one space apart."""
    return " ".join(" ".join(element.itertext()).split())


def by_id(document: ElementTree.Element, name: str) -> ElementTree.Element:
    (found,) = (one for one in document.iter() if one.get("id") == name)
    return found


def row_of(text: str, anchor: str) -> ElementTree.Element:
    """Return the section of a row, which the page makes when the reader opens it."""
    data = data_of(text)
    parser = html5lib.HTMLParser(strict=True, namespaceHTMLElements=False)
    section: ElementTree.Element = parser.parseFragment(data["rows"][anchor]["html"])
    return section


def without_library(text: str) -> str:
    """Return a page without the scripts."""
    return re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)


def test_the_page_is_valid_and_has_a_row_and_a_section_for_each_method(records: Path) -> None:
    text = page(compute_board(records), {})
    section = by_id(parsed(text), "clbench/Toy-v0")
    links = [one.get("href") for one in section.iterfind(".//table/tbody/tr/th/a")]
    assert links[:2] == ["#clbench/Toy-v0/better", "#clbench/Toy-v0/sft"]
    for method in ("better", "sft"):
        own = words(row_of(text, f"clbench/Toy-v0/{method}"))
        assert f"clbench run clbench/Toy-v0 {method} --seeds 2" in own
        assert "after target_1" in own
        assert "self-reported" in own
    assert "after target_1 0.50 0.40 0.30 0.80 , trained in this stage 0.10" in words(
        row_of(text, "clbench/Toy-v0/sft")
    )


def test_the_numbers_of_a_section_are_those_of_the_board(records: Path) -> None:
    board = compute_board(records)
    data = data_of(page(board, {}))
    for row in board.rows:
        shown = data["rows"][f"clbench/Toy-v0/{row.method}"]
        names = [title for title, *_ in data["scenarios"]["clbench/Toy-v0"]["metrics"]]
        texts = dict(zip(names, shown["metrics"], strict=True))
        known = {
            name.replace("_", " "): estimate
            for name, estimate in row.estimates.items()
            if estimate.value is not None and name.replace("_", " ") in texts
        }
        assert len(known) >= 5
        assert {name: texts[name][0] for name in known} == {
            name: format_interval(estimate) for name, estimate in known.items()
        }
        for value, low, high in shown["retained"]:  # what the page writes is rounded once
            assert all(end is None or end == round(end, 9) for end in (value, low, high))


def test_rows_show_their_groups_and_what_intervals_do_not_cover(records: Path) -> None:
    section = by_id(parsed(page(compute_board(records), {})), "clbench/Toy-v0")
    cells = [one for one in section.iter("td") if one.get("class") == "letters"]
    assert [(one.text, one.get("data-order"), one.get("data-note")) for one in cells] == [
        ("a", "1", "place 1 of 2; not told apart from sft"),
        ("a", "2", "place 2 of 2; not told apart from better"),
    ]
    assert "do not cover what all seeds share: demonstrations, scenes and questions" in words(section)


@pytest.mark.long
def test_perturbed_retention_has_a_column_only_where_a_row_has_it(
    add: Callable[..., Path], records: Path
) -> None:
    assert "perturbed retention" not in words(
        by_id(parsed(page(compute_board(records), {})), "clbench/Toy-v0")
    )
    for seed in range(2):
        add("sft", seed, perturbed=[[0.9, 0.8], [0.5, 0.7], [0.4, 0.2]])
    text = page(compute_board(records), {})
    section = by_id(parsed(text), "clbench/Toy-v0")
    heads = [words(one) for one in section.iterfind(".//table/thead/tr/th")]
    assert heads.index("perturbed retention") > heads.index("kept skills")
    assert ", missing: The run has no perturbed episodes" in words(section)
    own = words(row_of(text, "clbench/Toy-v0/sft"))
    assert re.search(r"perturbed retention Success [^0-9]*0\.30 \[", own)
    assert "clbench run clbench/Toy-v0 sft --seeds 2 --perturb" in own
    better = words(row_of(text, "clbench/Toy-v0/better"))
    assert "\N{EN DASH} The run has no perturbed episodes" in better
    assert "--seeds 2 --perturb" not in better


def test_a_row_says_what_its_verification_looked_at_and_which_lie_it_could_have_missed(records: Path) -> None:
    method = "clbench/Toy-v0/sft"
    assert "Checked by others" not in words(row_of(page(compute_board(records), {}), method))
    record = record_path(records, "clbench/Toy-v0", "sft", 0)
    found = "40 of 900 replayed, all ended as recorded; 64 made-up ones would have been found with 95 %"
    checks = [{"name": "episodes", "found": found, "passed": True}, {"name": HOSTILE, "found": "\x1b[2J"}, 7]
    text = record.read_bytes()
    values = {"tier": "replayed", "record": hashlib.sha256(text).hexdigest(), "checks": checks, "by": "Ada"}
    tiers.verification_path(record).write_text(tiers.verification_text(values), encoding="utf-8")
    own = row_of(page(compute_board(records), {}), method)
    assert f"seeds 0 tier replayed by Ada episodes {found} " in words(own)
    assert "\x1b" not in words(own)
    assert not list(own.iter("img"))


def test_a_tier_says_how_many_runs_reached_a_higher_one(records: Path) -> None:
    record = record_path(records, "clbench/Toy-v0", "sft", 0)
    values = {"tier": "retrained", "record": hashlib.sha256(record.read_bytes()).hexdigest()}
    tiers.verification_path(record).write_text(tiers.verification_text(values), encoding="utf-8")
    text = page(compute_board(records), {})
    assert "self-reported; 1 of 2 runs retrained" in words(row_of(text, "clbench/Toy-v0/sft"))
    section = by_id(parsed(text), "clbench/Toy-v0")
    cells = [one for one in section.iter("td") if (one.get("class") or "").startswith("tier")]
    assert [(words(one), one.get("data-note")) for one in cells] == [
        ("self-reported", None),
        ("self-reported ; 1 of 2 runs retrained", "self-reported; 1 of 2 runs retrained"),
    ]
    sentence = "A row has the lowest tier of its runs. Runs with a higher tier: 1 of 4 retrained."
    assert f"4 runs. {sentence}" in words(section)
    assert sentence in markdown(compute_board(records), {})
    assert "At least one run was checked only by its submitter." in words(section)


@pytest.mark.long
def test_a_missing_value_is_a_dash_that_says_why(add: Callable[..., Path], records: Path) -> None:
    section = by_id(parsed(page(compute_board(records), {})), "clbench/Toy-v0")
    assert "forward transfer" not in [words(one) for one in section.iterfind(".//table/thead/tr/th")]
    add("from_scratch", 0, uses={"demonstrations": "never", "questions": "never", "reference": True})
    add("single", 0)
    text = words(by_id(parsed(page(compute_board(records), {})), "clbench/Toy-v0"))
    assert "a point of a learning curve is missing, or there is no from_scratch of the same seeds" in text


@pytest.mark.slow
def test_the_same_records_give_the_same_bytes_in_another_place_time_zone_and_locale(
    records: Path, tmp_path: Path
) -> None:
    resolve("clbench.leaderboard.cli:show")(records=records)
    names = ["index.html", "pareto.svg", "pareto-dark.svg"]
    here = [(records.parent / "site" / name).read_bytes() for name in names]
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "leaderboard").mkdir(parents=True)
    (records.parent / "records").rename(elsewhere / "leaderboard" / "records")
    environment = {**os.environ, "TZ": "Asia/Tokyo", "LC_ALL": "C", "LANG": "de_DE", "PYTHONHASHSEED": "7"}
    command = [sys.executable, "-m", "clbench", "leaderboard"]
    subprocess.run(command, cwd=elsewhere, env=environment, check=True, capture_output=True)
    assert [(elsewhere / "leaderboard" / "site" / name).read_bytes() for name in names] == here


def test_a_diagnostic_is_a_mean_over_the_seeds_that_have_it(add: Callable[..., Path], records: Path) -> None:
    def learned_before_the_first_step(record: Record) -> None:
        record.diagnostics = {"1": {"shed": 0.5, "way": [1.0, 3.0]}}

    def trained(record: Record) -> None:
        record.diagnostics = {stage: {"shed": 0.25, "way": [2.0, 4.0]} for stage in ("1", "2")}

    add("sft", 0, edit=learned_before_the_first_step)
    add("sft", 1, edit=trained)
    html = data_of(page(compute_board(records), {}))["rows"]["clbench/Toy-v0/sft"]["html"]
    shed, way = (re.search(rf'row">{name}</th>(.*)</tr>', html) for name in ("shed", "way"))
    assert shed
    assert way
    assert re.findall(r">([^<>]+)<", shed[1]) == ["0.375", "0.25 (1 of 2 seeds)"]
    assert re.findall(r">([^<>]+)<", way[1]) == ["1.5 → 3.5", "2 → 4 (1 of 2 seeds)"]


def test_texts_of_strangers_stay_text(add: Callable[..., Path], records: Path) -> None:
    def edit(record: Record) -> None:
        record.run.settings = {HOSTILE: HOSTILE}
        record.diagnostics = {"1": {HOSTILE: HOSTILE, "x": [1.0, 2.0]}, HOSTILE: {"y": [HOSTILE]}}
        record.fingerprint.update(hardware={"processor": HOSTILE}, commit=HOSTILE, python=[{HOSTILE: 1}])

    def fail(record: Record) -> None:
        record.status = "failed"
        record.error = {"where": "loss", "type": "E", "message": HOSTILE, "traceback": ""}

    add("hostile", 0, edit=edit, scenario="clbench/Hostile-v0")
    add("failed", 0, edit=fail)
    (records / "<img src=x onerror=alert(2)>.json").write_text("{", encoding="utf-8")
    text = page(compute_board(records), {})
    document = parsed(text)
    assert not list(document.iter("img"))
    assert len(list(document.iter("script"))) == 4
    assert not [name for one in document.iter() for name in one.attrib if name.startswith("on")]
    section = row_of(text, "clbench/Hostile-v0/hostile")
    assert not list(section.iter("img"))
    assert words(section).count(HOSTILE) >= 7
    shown = words(document)
    assert HOSTILE in shown
    assert "<img src=x onerror=alert(2)>.json" in shown


def test_a_command_can_be_pasted_with_any_record(add: Callable[..., Path], records: Path) -> None:
    def edit(record: Record) -> None:
        record.run.device = "cpu; touch /tmp/gone"
        record.fingerprint["commit"] = {"id": "; touch /tmp/gone", "dirty": True}

    add("careless", 3, edit=edit)
    text = words(row_of(page(compute_board(records), {}), "clbench/Toy-v0/careless"))
    assert (
        "clbench run clbench/Toy-v0 careless --seeds 1 --first-seed 3 --device 'cpu; touch /tmp/gone'" in text
    )
    assert "git checkout" not in text


def test_seeds_of_several_commits_are_made_again_from_each(add: Callable[..., Path], records: Path) -> None:
    for seed, commit in ((0, "a"), (1, "b"), (2, "b"), (5, "b")):
        add(
            "old",
            seed,
            edit=lambda record, commit=commit: record.fingerprint.update(commit={"id": commit * 40}),
        )
    text = words(row_of(page(compute_board(records), {}), "clbench/Toy-v0/old"))
    install, run = "pip install -c constraints.txt -e .", "clbench run clbench/Toy-v0 old --seeds"
    first = f"git checkout {'a' * 40} {install} {run} 1"
    assert f"{first} git checkout {'b' * 40} {install} {run} 2 --first-seed 1 {run} 1 --first-seed 5" in text


def test_the_page_asks_no_address_and_allows_no_script_but_its_own(records: Path) -> None:
    text = page(compute_board(records), {})
    document = parsed(text)
    (policy,) = (one.get("content", "") for one in document.iter("meta") if one.get("http-equiv"))
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    assert not [one for one in document.iter() if one.get("style") or one.get("src")]
    rest = without_library(text)
    sections = [document, *(row_of(text, f"clbench/Toy-v0/{method}") for method in ("sft", "better"))]
    links = {one.get("href", "") for section in sections for one in section.iter("a")}
    links = {link for link in links if not link.startswith("#")} - {"leaderboard.csv", "board.json"}
    ours = ("https://arxiv.org/abs/", "https://github.com/clbench/clbench")
    assert all(link.startswith(ours) for link in links)
    namespaces = {"https://vega.github.io/schema/vega-lite/v6.json"}
    assert set(ADDRESS.findall(rest)) <= links | namespaces


def test_files_that_make_no_row_are_listed_with_their_reason(records: Path) -> None:
    (records / "torn.json").write_text("{", encoding="utf-8")
    text = words(by_id(parsed(page(compute_board(records), {})), "not-shown"))
    assert "torn.json cannot be read as JSON" in text
    assert "What to do" in text


@pytest.mark.long
def test_definitions_that_rank_in_opposite_orders_are_named(add: Callable[..., Path], records: Path) -> None:
    # one forgets the skills alone, one the targets alone: the metrics distinguish them
    for seed in range(2):
        for same in ("neither", "nothing"):
            add(same, seed, [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 1, 1, 0]], scenario="clbench/Two-v0")
        add("skills", seed, [[1, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 1, 1, 0]], scenario="clbench/Two-v0")
        add("targets", seed, [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 0, 1, 0]], scenario="clbench/Two-v0")
    document = parsed(page(compute_board(records), {}))
    text = words(by_id(document, "clbench/Two-v0"))
    assert "“forgetting” and “backward transfer” disagree most. They put 1 of 6 pairs of methods" in text
    (table,) = (
        one for one in by_id(document, "clbench/Two-v0").iter("table") if one.get("class") == "definitions"
    )
    ranks = {words(row[0]): [words(cell) for cell in row[1:3]] for row in table.iterfind("tbody/tr")}
    assert ranks["skills"] == ["4 , depends on the definition", "1"]
    assert ranks["targets"] == ["3 , depends on the definition", "4"]
    assert ranks["neither"] == ["1", "1"]


def test_fewer_than_four_methods_have_no_table_of_definitions(records: Path) -> None:
    section = by_id(parsed(page(compute_board(records), {})), "clbench/Toy-v0")
    assert not [one for one in section.iter("table") if one.get("class") == "definitions"]


def test_the_only_method_of_a_division_has_a_dash_instead_of_a_letter(
    add: Callable[..., Path], records: Path
) -> None:
    add("alone", 0, scenario="clbench/Other-v0")
    section = by_id(parsed(page(compute_board(records), {})), "clbench/Other-v0")
    cells = [one for one in section.iter("td") if one.get("class") == "letters"]
    assert [(one.text, one.get("data-note")) for one in cells] == [("\N{EN DASH}", "place 1 of 1")]


def test_the_stages_of_an_agent_begin_after_the_old_skills(add: Callable[..., Path], records: Path) -> None:
    uses = {"demonstrations": "never", "questions": "never", "reference": False, "online": True}
    add("me/agent", 0, uses=uses)
    text = page(compute_board(records), {})
    assert "after the old skills" in words(row_of(text, "clbench/Toy-v0/me/agent"))
    data = data_of(text)
    chart = json.dumps(data["scenarios"]["clbench/Toy-v0"]["run_elsewhere"])
    assert data["rows"]["clbench/Toy-v0/me/agent"]["elsewhere"]
    assert "stages, one after another" in chart
    assert "optimiser steps" not in chart
    assert "pretrained" in words(row_of(text, "clbench/Toy-v0/sft"))


def test_the_main_scenario_comes_first_and_names_are_short(add: Callable[..., Path], records: Path) -> None:
    add("sft", 0, scenario="clbench/Fetch-v1")
    document = parsed(page(compute_board(records), {}))
    (tabs,) = (one for one in document.iter("nav") if one.get("class") == "tabs")
    assert [words(one) for one in tabs.iter("a")] == ["Fetch-v1", "Toy-v0", "All scenarios"]
    assert "Every file" not in words(document)


def test_without_rows_there_is_a_page_that_says_why(tmp_path: Path) -> None:
    (tmp_path / "torn.json").write_text("{", encoding="utf-8")
    table = compute_board(tmp_path)
    text = words(parsed(page(table, {})))
    assert "There are no rows yet" in text
    assert "torn.json" in text
    assert set(pictures(table)) == {"pareto.svg", "pareto-dark.svg"}


def test_the_pictures_show_every_method_in_both_themes(records: Path) -> None:
    drawn = pictures(compute_board(records))
    for picture in drawn.values():
        texts = [
            "".join(one.itertext())
            for one in ElementTree.fromstring(picture).iter()
            if one.tag.endswith("text")
        ]
        assert {"sft", "better", "prior-data-free"} <= set(texts)
        assert "var(" not in picture
        assert "<script" not in picture
    assert drawn["pareto.svg"] != drawn["pareto-dark.svg"]


@pytest.mark.long
def test_15_methods_with_5_seeds_on_4_scenarios_are_less_than_3_megabytes(
    make_record: Callable[..., Record], tmp_path: Path
) -> None:
    generator = np.random.default_rng(0)
    for seed in range(5):
        record = make_record(
            generator.integers(2, size=(5, 12, 20)).astype(float),
            curves=generator.random((4, 3)),
            retained_curves=generator.random((4, 3, 6)),
            validation=generator.random((4, 4)),
            answers={(stage, f"kind_{kind}"): (72, 60) for stage in range(5) for kind in range(14)},
            groups=(6, 4, 2),
            curve_episodes=5,
            method="method",
            seed=seed,
        )
        diagnosed = {"distance": generator.random(11).tolist(), **{f"share_{n}": n / 7 for n in range(3)}}
        record.diagnostics = {str(stage): diagnosed for stage in range(1, 5)}
        record.fingerprint["versions"] = {f"package-{number}": "1.22.333" for number in range(9)}
        write_record(record, record_path(tmp_path, "clbench/Toy-v0", "method", seed))
    table = compute_board(tmp_path)
    (row,), (scenario,) = table.rows, table.scenarios.values()
    names = [f"clbench/Scenario{number}-v0" for number in range(4)]
    rows = [
        dataclasses.replace(row, scenario=name, method=f"method_{number:02}")
        for name in names
        for number in range(15)
    ]
    large = dataclasses.replace(table, rows=tuple(rows), scenarios=dict.fromkeys(names, scenario))
    text = page(large, {})
    assert len(data_of(text)["rows"]) == 60
    assert len(text.encode()) < 3_000_000
