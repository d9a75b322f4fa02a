"""The page of the claims: every verdict follows from records by its rule, and no input breaks it."""

import json
import re
from collections.abc import Callable
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
from claims_bench import IDS, SCENARIO, Bench, section, verdicts
from helpers import sealed

from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.spec.registry import load_scenario

ROOT = Path(__file__).parents[3]
CLAIMS = resolve("clbench.leaderboard.claims.judges:CLAIMS")
verification_path, verification_text = (
    resolve(f"clbench.leaderboard.board.tiers:{name}") for name in ("verification_path", "verification_text")
)

RULES = {
    "C1": ("11-23 07:13", "7af4eb25"),
    "C2": ("11-27 20:50", "131a1d92"),
    "C3": ("11-28 20:50", "590daa7a"),
    "C4": ("11-29 01:25", "6c1d17bf"),
    "C5": ("11-23 07:13", "80fc1c75"),
    "C6": ("11-26 20:19", "c82929bc"),
    "C7": ("11-27 20:50", "fd526e41"),
    "C8": ("11-27 20:50", "9b95f12f"),
    "A1": ("11-23 07:13", "b5322577"),
    "A2": ("11-28 17:29", "964dd113"),
    "A3": ("11-23 07:13", "93d38edc"),
    "A4": ("11-23 07:13", "18964cb4"),
    "A5": ("11-23 07:13", "484f3624"),
    "A6": ("11-29 01:25", "f394d836"),
    "A7": ("11-28 20:50", "f25b2986"),
    "F1": ("11-28 20:50", "6a0586b0"),
    "F2": ("11-29 01:25", "6a9a92d9"),
    "F3": ("11-28 20:50", "9ef10f3e"),
    "F4": ("11-23 07:13", "e412fbc1"),
    "F5": ("11-30 06:10", "73dacdd8"),
    "F6": ("11-28 20:50", "25fe6a0b"),
}
"""When each rule was settled, in 2026, and a hash of its words."""

ACTIVE = {"1": {"omega_counts": [[5, 5, 0, 0, 0], [0, 5, 3, 1, 1]]}}
SAME = {"1": {"omega_counts": [[98, 2, 0, 0, 0], [60, 0, 0, 0, 40]]}}


@pytest.mark.long
@pytest.mark.parametrize(
    ("identifier", "method", "limit"),
    [("C6", "consft", 1.05), ("A7", "aegis", 1.6), ("F4", "fast_dvla", 1.05)],
)
def test_claims_of_costs_are_judged_by_the_time_of_a_step(
    identifier: str, method: str, limit: float, bench: Bench
) -> None:
    bench.add("sft")
    bench.add(method, costs={"optimiser_steps": 400, "preparation_steps": 40})
    assert verdicts(bench.page())[identifier] == "undecided"
    for ratio, verdict in ((-0.02, "holds"), (0.0, "undecided"), (0.02, "does not hold")):
        bench.step_ratio(method, limit + ratio)
        page = bench.page()
        assert verdicts(page)[identifier] == verdict
    assert f"| {limit + 0.02:.2f} [{limit + 0.02:.2f}, {limit + 0.02:.2f}] |" in section(page, identifier)
    assert f"would have to move by 0.02 to reach {limit:.2f}." in section(page, identifier)


def test_without_any_record_every_claim_says_which_command_is_missing(bench: Bench) -> None:
    page = bench.page()
    assert list(verdicts(page)) == IDS
    others = {"C5": "holds"}
    assert verdicts(page) == {identifier: others.get(identifier, "undecided") for identifier in IDS}
    assert "clbench run" not in section(page, "C5")  # no record can change it
    for identifier in set(IDS) - {"C5"}:
        command = "python benchmarks/decoding.py" if identifier == "F6" else "clbench run"
        assert command in section(page, identifier)
    sft_on_the_ladder = f"`clbench run {SCENARIO} sft --set.step_factor 1 --records {bench.folder}/ladder`"
    assert sft_on_the_ladder in section(page, "C2")
    assert f"`clbench run {SCENARIO} aegis frozen sft --records {bench.folder}/records`" in section(
        page, "A4"
    )
    at_random = f"aegis --set.direction random --records {bench.folder}/controls"
    assert f"`clbench run {SCENARIO} {at_random}`" in section(page, "A4")


def started(text: object) -> Callable[[Record], None]:
    """Return an edit that sets when a run started."""
    return lambda record: record.timing.update(started=text)


def test_the_page_says_how_many_rules_changed_after_the_first_record_that_they_judge(bench: Bench) -> None:
    bench.add("sft", edit=started("2026-11-25T12:00:00+00:00"))
    bench.add("frozen", edit=started("2026-11-26T12:00:00+00:00"))
    later = [one for one in CLAIMS.values() if one.settled > datetime(2026, 11, 25, 12, tzinfo=UTC)]
    assert 0 < len(later) < len(IDS)
    text = f"dates from 2026-11-25; {len(later)} of the {len(IDS)} rules changed after it."
    assert text in bench.page()


@pytest.mark.parametrize("text", [None, 7, "yesterday", "2999-01-01"])
def test_a_record_may_say_anything_about_its_start(bench: Bench, text: object) -> None:
    bench.add("sft", edit=started(text))
    known = text == "2999-01-01"
    assert (f"dates from 2999-01-01; none of the {len(IDS)} rules changed after it." in bench.page()) == known


def test_a_verdict_says_how_many_of_its_records_another_process_replayed_or_repeated(bench: Bench) -> None:
    for label in ("sft", "frozen", "sft@1"):
        bench.add(label)
    # C1 reads sft, frozen and the ladder's sft, three seeds each
    assert "- Of the 9 records behind the figures, another process replayed none." in section(
        bench.page(), "C1"
    )
    for method, tier in (("sft", "replayed"), ("frozen", "replayed"), ("frozen", "retrained")):
        record = record_path(bench.folder / "records", SCENARIO, method, 0 if tier == "replayed" else 1)
        values = {"tier": tier, "record": sha256(record.read_bytes()).hexdigest()}
        verification_path(record).write_text(verification_text(values), encoding="utf-8")
    said = "- Of the 9 records behind the figures, another process replayed 2 and repeated 1 as a whole."
    assert said in section(bench.page(), "C1")
    assert "records behind the figures" not in section(bench.page(), "C5")  # algebra


def test_a_rule_that_says_something_new_gets_the_time_of_its_change() -> None:
    """If you changed what a rule says, change its `settled` and its line here; else its line alone."""
    found = {
        one.id: (one.settled.strftime("%m-%d %H:%M"), sha256(one.rule.encode()).hexdigest()[:8])
        for one in CLAIMS.values()
    }
    assert found == RULES


def test_every_claim_has_its_paper_rule_and_the_papers_figure(bench: Bench) -> None:
    page = bench.page()
    for identifier in IDS:
        assert "- Rule: " in section(page, identifier)
        assert "- In the paper: " in section(page, identifier)
    for arxiv in ("2605.08879", "2604.16067", "2603.25661", "2605.10903"):
        assert f"[arXiv {arxiv}](https://arxiv.org/abs/{arxiv})" in page


def test_the_bound_of_a_step_names_a_test_that_exists(bench: Bench) -> None:
    entry = section(bench.page(), "C5")
    names = re.findall(r"`(test_\w+)` of `(tests/[\w/]+\.py)`", entry)
    assert names
    for test, path in names:
        assert f"def {test}(" in (Path(__file__).parents[3] / path).read_text(encoding="utf-8")


@pytest.mark.long
def test_an_arm_whose_samples_weigh_the_same_does_not_count_and_the_page_says_so(bench: Bench) -> None:
    bench.add("sft")
    bench.add("sft@1")
    bench.add("consft", kept=0.8, diagnostics=SAME)
    bench.add("consft_calibrated", diagnostics=ACTIVE)
    entry = section(bench.page(), "C2")
    # the second row of the table is the last tenth of the schedule, and does not count
    assert (
        "2.0% of the weights of consft lie between 0.01 and 0.9: most samples have nearly the same" in entry
    )
    assert "weights of consft_calibrated lie" not in entry


@pytest.mark.long
def test_a_control_says_whether_it_explains_what_is_kept(bench: Bench) -> None:
    for label in ("sft", "sft@1", "finch"):
        bench.add(label)
    bench.add("consft", kept=0.8)
    for method in ("consft_calibrated", "constant_weight"):
        bench.add(method, kept=0.9)
    entry = section(bench.page(), "C2")
    assert "constant_weight is not told apart from consft_calibrated" in entry
    assert (
        "finch does not reach consft_calibrated: a learning rate that follows the loss does not suffice."
        in entry
    )
    assert "The records cannot show what shuffled_weights says about consft_calibrated." in entry


@pytest.mark.long
def test_what_keeps_skills_at_the_scenarios_learning_rate_is_asked_of_controls_there(bench: Bench) -> None:
    for label in ("sft", "sft@1", "consft", "consft@1", "consft_calibrated"):
        bench.add(label)
    for label in ("consft_calibrated@1", "constant_weight+step_factor=1.0"):
        bench.add(label, kept=0.9)
    bench.add("shuffled_weights+step_factor=1.0", kept=0.2)
    entry = section(bench.page(), "C2")
    assert (
        "At the scenario's learning rate, consft_calibrated@1 keeps 0.70 more than sft; constant_weight is "
        "not told apart from consft_calibrated@1: weighing single samples need not be what keeps skills; "
        "shuffled_weights does not reach consft_calibrated@1: it may matter which samples get small weights."
    ) in entry


@pytest.mark.long
def test_a_gain_that_a_control_shares_is_not_put_down_to_the_weights(bench: Bench) -> None:
    bench.add("sft", earlier=0.2)
    for label in ("consft", "consft_calibrated", "constant_weight", "shuffled_weights"):
        bench.add(label, earlier=0.9)
    bench.add("finch", earlier=0.2)
    assert (
        "sft at its best learning rate certainly keeps fewer, but constant_weight and shuffled_weights do "
        "not: weighing samples need not be the cause."
    ) in section(bench.page(), "C7")


def test_an_undecided_claim_says_how_many_seeds_would_decide(bench: Bench) -> None:
    bench.add("sft", kept=(0.85, 0.9, 0.95))
    entry = section(bench.page(), "C1")
    # the drop is .10, .05 above the bar, and its deviation .05: Student's interval of 7 seeds reaches .046
    found = re.search(r"At this spread, about (\d+) seeds would be needed: .* contains 0.05", entry)
    assert found
    assert int(found[1]) == 7


def test_a_verdict_belongs_to_its_scenario(bench: Bench) -> None:
    bench.add("sft")
    output = bench.folder / "claims.md"
    resolve("clbench.leaderboard.pages.cli:claims")(
        records=bench.folder / "records", controls=bench.folder / "controls", output=output
    )
    page = output.read_text(encoding="utf-8")
    boards = "Fetch-v1 | MetaWorld-v1 | PointMaze-v1 | LiberoSpatial-v1 | FetchKnowledge-v1"
    assert f"| id | claim | measured quantity | {boards} |" in page
    (row,) = (line for line in page.splitlines() if line.startswith("| [C1]"))
    assert row.split(" | ")[3:] == ["undecided"] * 4 + [" |"]


def test_a_seed_that_one_of_two_methods_lacks_is_left_out(bench: Bench) -> None:
    bench.add("sft", seeds=3)
    bench.add("stop_gradient", seeds=2, right=(490, 490))
    rows = [line for line in section(bench.page(), "A2").splitlines() if line.startswith("| ")]
    assert "| 0, 1 |" in next(row for row in rows if "evaluated steps, stop" in row)


def test_one_seed_is_shown_and_decides_nothing(bench: Bench) -> None:
    bench.add("sft", seeds=1)
    page = bench.page()
    assert verdicts(page)["C1"] == "undecided"
    assert re.search(r"\| 0\.80 \[0\.\d+, 0\.\d+\] \| 0 \| one seed", section(page, "C1"))


def test_the_curve_of_the_answers_is_shown_over_the_steps(bench: Bench) -> None:
    bench.add("sft")
    entry = section(bench.page(), "A1")
    for step in (50, 100):
        assert f"question accuracy, pretrained - sft after {step} steps of the first target" in entry


def test_a_control_that_was_not_evaluated_like_the_board_is_left_out_with_its_reason(bench: Bench) -> None:
    bench.add("frozen", right=(500, 500))
    bench.add("aegis", right=(500, 500))
    bench.add("aegis+direction=random", edit=lambda record: record.scenario.budget.update(adaptation_steps=9))
    page = bench.page()
    assert "--set.direction random" in section(page, "A4")
    place = "controls/Toy-v0/aegis+direction=random/seed-0.json"
    assert f"- {place}: it cannot be compared with the board: budget differ." in page.splitlines()


def test_records_among_the_controls_that_changed_nothing_are_left_out(bench: Bench) -> None:
    bench.add("sft")
    (bench.folder / "records").rename(bench.folder / "controls")
    page = bench.page()
    assert verdicts(page)["C1"] == "undecided"
    assert "no setting was changed" in page


def test_a_rung_with_another_change_is_not_taken_for_the_published_method(bench: Bench) -> None:
    bench.add("consft@1", kept=0.2)
    bench.add("consft+kappa=9@1", kept=0.9)  # kind: the ladder
    evidence = bench.evidence()
    assert evidence.metric("retention", "consft@1").value == pytest.approx(0.2)
    assert evidence.metric("retention", "consft+kappa=9@1").value == pytest.approx(0.9)


def test_an_unknown_scenario_is_refused_and_the_page_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "claims.md"
    page.write_text("what was there")
    for command in ("claims", "method-pages"):
        with pytest.raises(SystemExit):
            resolve("clbench.cli.main:app")(
                [command, "--scenario", "clbench/Fetsch-v1", "--output", str(page)]
            )
        assert "Did you mean 'clbench/Fetch-v1'?" in capsys.readouterr().err
    assert page.read_text() == "what was there"


def test_words_of_strangers_stay_on_their_line_and_are_no_markup(bench: Bench) -> None:
    hostile = "x | [bold]y[/bold]\n## z <b> ``` \x1b[31m https://x.example"

    def fail(record: Record) -> None:
        record.status = "failed"
        record.error = {"where": "loss", "type": "ValueError", "message": hostile, "traceback": ""}

    def rename(record: Record) -> None:
        record.run.method = hostile

    bench.add("consft", edit=fail)
    bench.add("lora+rank=4", edit=rename)
    bench.add("lora+rank=64", edit=fail)
    page = bench.page()
    assert "\n## z" not in page
    assert "\x1b" not in page
    assert "<b>" not in page.replace("\\<", "")
    assert "https://x" not in page
    assert verdicts(page)["A3"] == "undecided"


def test_any_damage_to_a_record_leaves_a_page(bench: Bench) -> None:
    bench.add("sft")
    damages: tuple[Any, ...] = (None, -1, "x", [None], {"x": []})
    path = record_path(bench.folder / "records", SCENARIO, "sft", 0)
    whole = json.loads(path.read_text(encoding="utf-8"))
    for number, name in enumerate(whole):
        for damage in damages:
            text = json.dumps({**sealed({**whole, name: damage}), name: damage})
            place = record_path(bench.folder / "controls", SCENARIO, f"sft+x={number}", 0)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(text, encoding="utf-8")
            place.with_name(f"{damage!r}.json").write_text(text, encoding="utf-8")
    assert list(verdicts(bench.page())) == IDS


def test_the_same_records_give_the_same_bytes_and_no_place_or_date(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.add("sft")
    bench.add("consft", kept=0.6)
    first = bench.page()
    printed = capsys.readouterr().out
    assert bench.page() == first
    assert capsys.readouterr().out == printed.replace("Written: ", "Unchanged: ")
    assert str(bench.folder) not in re.sub(
        r"--records \S+", "", first
    )  # commands name the folder of the user
    assert not re.search(r"(?<!- The rule dates from )\b20\d\d-\d\d", first)
    assert (
        len({line.count("|") - line.count("\\|") for line in first.splitlines() if line.startswith("| [")})
        == 1
    )


def test_the_terminal_has_id_verdict_and_figure(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.add("sft")
    bench.page()
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["C1", "Toy-v0", "holds", "0.80"] in [line[:4] for line in lines]
    assert [line[0] for line in lines if line and line[0] in IDS] == IDS


def test_the_command_is_part_of_the_command_line() -> None:
    app = resolve("clbench.cli.main:app")
    assert app["claims"] is not None
    assert app["method-pages"] is not None


@pytest.mark.parametrize(("method", "least", "most"), [("aegis", 61, 202), ("lora", 3, 111)])
def test_untuned_methods_exceed_the_tuned_rates_of_other_boards_as_the_page_says(
    method: str, least: int, most: int
) -> None:
    times = []
    for name in ("Fetch-v1", "MetaWorld-v1", "PointMaze-v1"):
        tuned = json.loads((ROOT / f"methods/tuned/{name}.json").read_text(encoding="utf-8"))
        factor = tuned["methods"][method]["settings"]["step_factor"]
        rates = [load_scenario(f"clbench/{one}").budget.learning_rate for one in ("FetchKnowledge-v1", name)]
        times.append(rates[0] / (factor * rates[1]))
    assert (round(min(times)), round(max(times))) == (least, most)
    page = (ROOT / "docs/reference/claims.md").read_text(encoding="utf-8")
    assert f"its learning rate is {least} to {most} times those that tuning chose elsewhere" in page
