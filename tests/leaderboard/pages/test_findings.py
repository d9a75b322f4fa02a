"""The findings say what the records show: every sentence follows from made-up records."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers import sealed

from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.record import Record, Relearning
from clbench.records.writer import write_record
from clbench.scoring.intervals import Estimate

findings = resolve("clbench.leaderboard.pages.cli:findings")


MISSED = r"\(50% of its stages missed the criterion\)"


def cells_of(text: str, start: str) -> list[str]:
    """Return the cells of the line of a table that begins with `start`."""
    (line,) = (line for line in text.splitlines() if line.startswith(start))
    return [cell.strip() for cell in line.strip("|").split(" | ")]


@pytest.fixture
def _tied(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let tuning have rated plain fine-tuning alike at the scenario's learning rate and at a tenth of it."""
    tuned, tried = (resolve(f"clbench.runs.tuning:{name}") for name in ("Tuned", "Tried"))
    rates = tuple(tried({"step_factor": factor}, 0.5, 0.9) for factor in (1.0, 0.1))
    found = {"sft": tuned({"step_factor": 1.0}, rates)}
    for module in ("certainty", "rows"):
        monkeypatch.setattr(f"clbench.leaderboard.board.{module}.tuned", lambda scenario: found)


def fill(even_board: Callable[..., Path], **kept: float) -> None:
    for seed in range(4):
        for method, share in kept.items():
            even_board(method, seed, share)


@pytest.mark.long
def test_a_method_that_is_certainly_better_is_named_with_its_gain(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    fill(even_board, sft=0.4, finch=0.8, lora=0.4, l2_sp=0.0)
    text = page()
    # kept counts two skills and one earlier target of four tasks in all: a gain of 3/4 of the difference
    assert re.search(r"Without prior demonstrations: `finch` gains 0\.30 \[.*?\] on Even-v1\.", text)
    assert "With prior demonstrations: no method is certainly better than plain fine-tuning on" in text
    assert (
        "## Does a method without prior demonstrations beat plain fine-tuning?\n" in text
    )  # nothing is tuned
    assert "On Even-v1, yes: `finch` by 0.300 [" in text
    _, compared, largest, _, apart, alone = cells_of(text, "| Even-v1 | 3 methods")
    assert compared == "3 methods, 4 seeds"
    assert largest.startswith("`finch` 0.300 [")
    assert re.fullmatch(rf"`finch` 0\.300 \[.*?\] {MISSED}; `l2_sp` -0\.300 \[.*?\] {MISSED}", apart)
    assert alone == "-"


@pytest.mark.long
def test_without_one_the_page_says_so_and_names_the_largest_gain(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    fill(even_board, sft=0.4, finch=0.4, lora=0.4)
    text = page()
    assert "- On Even-v1, no method is above plain fine-tuning and told apart from it.\n" in text
    _, _, largest, needed, *apart = cells_of(text, "| Even-v1 | 2 methods")
    assert re.fullmatch(rf"`finch` 0\.000 \[0\.000, 0\.000\] {MISSED}", largest)
    assert re.fullmatch(r"0\.\d{3}( to 0\.\d{3})?", needed)
    assert apart == ["-", "-"]


@pytest.mark.long
def test_a_difference_that_is_certain_only_without_counting_the_comparisons_is_said_to_be_so(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    same = {f"method_{number}": 0.4 for number in range(7)}
    fill(even_board, sft=0.4, finch=0.5, lora=0.3, **same)
    text = page()
    assert "- On Even-v1, no method is above plain fine-tuning and told apart from it.\n" in text
    _, _, largest, _, apart, alone = cells_of(text, "| Even-v1 | 9 methods")
    assert largest.startswith("`finch` 0.0")
    assert apart == "-"
    assert re.fullmatch(rf"`finch` 0\.0\d+ \[.*?\] {MISSED}; `lora` -0\.0\d+ \[.*?\] {MISSED}", alone)
    assert "they are not corrected for the number of methods." in text


@pytest.mark.parametrize("chances", [[], [0.01], [0.2, 0.03, 0.04, 0.01], [0.6, 0.02, 0.02, 0.5]])
def test_a_corrected_p_is_that_of_holm(chances: list[float]) -> None:
    corrected = resolve("clbench.leaderboard.pages.agreements:holm")(chances)
    for chance, found in zip(chances, corrected, strict=True):
        steps = [one * sum(other >= one for other in chances) for one in chances if one <= chance]
        assert found == pytest.approx(min(1.0, max(steps)))


@pytest.mark.parametrize(
    ("chances", "says"),
    [
        ([0.016, 0.039, 0.11, 0.2, 0.6, 0.7], "Of the 6 p-values here, 2 are below 0.05; after"),  # 6 x 0.016
        ([0.0001, 0.0002, 0.04], "Of the 3 p-values here, 3 are below 0.05; after"),
        ([0.2, 0.6], None),
        ([0.01], None),
    ],
)
def test_several_p_are_corrected_for_their_number(chances: list[float], says: str | None) -> None:
    sentences = list(resolve("clbench.leaderboard.pages.agreements:after_correction")(chances, "here"))
    stay = "none" if len(chances) == 6 else "3"
    assert sentences == ([f"{says} Holm's correction for their number, {stay}."] if says else [])


@pytest.mark.long
@pytest.mark.usefixtures("_tied")
def test_a_gain_that_is_not_certain_over_a_tied_setting_is_no_yes(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    fill(even_board, sft=0.4, finch=0.8, lora=0.4)
    for seed in range(4):
        even_board("sft", seed, 0.8, "ladder", step_factor=0.1)
    text = page()
    assert "On Even-v1, yes" not in text
    assert "On Even-v1, the gain of `finch` is not certain: it is 0.300" in text
    assert (
        "but 0.000 [0.000, 0.000] at 0.1 times the scenario's learning rate, which scored the same in tuning "
        "(4 seeds)." in text
    )
    assert re.search(r"`finch` 0\.300 \[.*?\] \(not over the tied setting; 50%", text)
    assert "beat tuned fine-tuning?\n" in text


@pytest.mark.usefixtures("_tied")
def test_where_a_tied_setting_has_no_runs_the_page_says_why_no_gain_is_certain(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    fill(even_board, sft=0.4, finch=0.8, experience_replay=0.9)
    keep_demonstrations(even_board("sft", 0, 0.4))
    text = page()
    why = (
        "- On Even-v1, no gain is certain: for plain fine-tuning, 0.1 times the scenario's learning rate "
        "scored the same in tuning, and the ladder beside these records has no runs of it"
    )
    for passage in ("## In short", "## What do prior demonstrations buy?"):
        assert why in text.partition(passage)[2].partition("\n## ")[0]
    assert re.search(r"`finch` 0\.300 \[.*?\] \(no runs at the tied setting; 50%", text)
    assert cells_of(text, "| Even-v1 | `experience_replay`")[2].endswith("] (not certain)")


def test_where_nothing_was_tuned_no_sentence_speaks_of_what_tuning_chose() -> None:
    gain_text = resolve("clbench.leaderboard.views.format:gain_text")
    text = gain_text("Even-v1", "`finch`", Estimate(0.1, -0.1, 0.3), ())
    assert text.endswith("is not certain: it is 0.100 [-0.100, 0.300] over plain fine-tuning.")


def judged(identifier: str, board: str, verdict: str, what: str, *sentences: str) -> Any:
    """Return a claim of the project with a verdict on a board."""
    claim = resolve("clbench.leaderboard.claims.judges:CLAIMS")[identifier]
    figure = resolve("clbench.leaderboard.claims.evidence:Figure")
    value = figure(what, ("consft", "sft"), Estimate(0.25, 0.125, 0.5))
    finding = resolve("clbench.leaderboard.claims.claim:Finding")
    found = finding(verdict, (value,), (), sentences, "Longer stages.")
    return SimpleNamespace(claim=claim, evidence=SimpleNamespace(scenario=board), finding=found)


def test_claims_that_hold_are_named_since_some_are_about_plain_fine_tuning(
    even_board: Callable[..., Path], page: Callable[[], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    every = (judged("C1", "a", "holds", "lost"), judged("C1", "b", "undecided", "lost"))
    monkeypatch.setattr("clbench.leaderboard.claims.judges.judge_all", lambda *_: every)
    fill(even_board, sft=0.4)
    text = page()
    assert 'ConSFT has 2 verdicts: 1 "holds" and 1 "undecided".\n' in text
    assert "| C1 | Unconstrained fine-tuning degrades pretrained skills. | holds | undecided |\n" in text


def test_the_page_begins_with_the_number_of_claims_by_their_best_verdicts(
    even_board: Callable[..., Path], page: Callable[[], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    every = (
        *(judged("C1", "a", "holds", "lost"), judged("C1", "b", "does not hold", "lost")),
        *(judged("C2", "a", "undecided", "lost"), judged("C5", "a", "holds", "lost")),  # C5 is not counted
    )
    monkeypatch.setattr("clbench.leaderboard.claims.judges.judge_all", lambda *_: every)
    fill(even_board, sft=0.4)
    counts = "1 holds, 0 hold in part and 1 does not hold on at least one board; 1 is undecided, or cannot be"
    assert f"Of the papers' 2 claims, {counts} shown, on every board." in page().partition("## Words")[0]


def test_a_claim_that_is_algebra_is_not_counted_with_those_that_records_judge(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    fill(even_board, sft=0.4)
    text = page()
    assert 'C5 is algebra and is not counted; it has 1 verdict: 1 "holds".' in text
    counted = re.search(r"ConSFT has \d+ verdicts: (.*?)\. C5 is algebra", text)
    assert counted
    assert '"holds"' not in counted[1]


def test_a_claim_is_a_line_with_a_verdict_for_each_board_and_what_explains_it(
    even_board: Callable[..., Path], page: Callable[[], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    every = (
        judged("C2", "clbench/a", "does not hold", "kept", "Half are 0.", "A constant weight keeps as much."),
        judged("C2", "b", "does not hold", "kept", "A constant weight keeps as much."),
        judged("C2", "c", "cannot be shown here", "kept", "It has no arm."),
        judged("C7", "b", "undecided", "lost", "Nothing explains it."),
        judged("C7", "c", "cannot be shown here", "lost in c"),
        judged("A4", "d", "does not hold", "answers", "It keeps none."),
    )
    monkeypatch.setattr("clbench.leaderboard.claims.judges.judge_all", lambda *_: every)
    fill(even_board, sft=0.4)
    section = page().partition("## Which claims of the papers hold here?")[2].partition("## ")[0]
    assert (
        '- ConSFT has 3 verdicts: 2 "does not hold" and 1 "cannot be shown here". C7 is our reading'
        in section
    )
    assert 'is our reading of the paper and is not counted; it has 2 verdicts: 1 "undecided"' in section
    assert "| id | claim | a | b | c | d |\n" in section
    none = "cannot be shown here"
    assert f"| C2 | {every[0].claim.words} | does not hold | does not hold | {none} |  |\n" in section
    assert f"| C7 | {every[3].claim.words} |  | undecided | {none} |  |\n" in section
    assert "| C2 | a and b | does not hold | A constant weight keeps as much. |\n" in section
    assert "| A4 | d | does not hold | It keeps none. |\n" in section
    for untold in ("Half are 0", "It has no arm", "Nothing explains it"):
        assert untold not in section
    assert "A claim is undecided if runs are missing or intervals are too wide." in section
    assert "FetchKnowledge-v1 was made to show claims on knowledge: its steps are large" in section


@pytest.mark.parametrize("other", ["skill_0", "skill_1"])
def test_how_fast_lost_skills_come_back_is_told_with_their_names(
    other: str, make_record: Callable[..., Record], tmp_path: Path, page: Callable[[], str]
) -> None:
    for method, skill, steps in (("sft", "skill_1", (8, 12)), ("from_scratch", other, (20, 20))):
        for seed in range(2):
            record = make_record(
                [[1, 1, 0, 0, 0], [0, 0, 0.9, 0, 0], [0, 0, 0, 0.9, 0]],
                method=method,
                seed=seed,
                scenario="clbench/Even-v1",
                steps=(20,),
                ends=(8, 20),
                relearning=Relearning(skill, 0, steps[seed], True),
            )
            write_record(record, record_path(tmp_path / "records", "clbench/Even-v1", method, seed))
    text = page()
    assert (
        "On Even-v1, plain fine-tuning loses a skill in 2 of 2 seeds, and meets the criterion again" in text
    )
    _, skills, took, never, *unpretrained = cells_of(text, "| Even-v1 | `skill_1`")
    assert (skills, never) == ("`skill_1` in 2", "0 of 2 seeds")
    assert took.startswith("10 [")
    # another skill says nothing of this one
    assert unpretrained == (["20 (`skill_1` in 2)"] if other == "skill_1" else [])


@pytest.mark.parametrize(
    ("met", "words"),
    [
        (0, ", and never meets the criterion again."),
        (1, ", and meets the criterion again in 1 of them; in 2, it never does."),
        (2, " again after 8 steps on the skill's demonstrations in 2 of them; in 1, it never does."),
    ],
)
def test_a_skill_that_does_not_come_back_is_said_to_be_gone(
    met: int, words: str, make_record: Callable[..., Record], tmp_path: Path, page: Callable[[], str]
) -> None:
    for seed in range(3):
        record = make_record(
            [[1, 1, 0, 0, 0], [0, 0, 0.9, 0, 0], [0, 0, 0, 0.9, 0]],
            method="sft",
            seed=seed,
            scenario="clbench/Even-v1",
            steps=(20,),
            ends=(8, 20),
            relearning=Relearning("skill_1", 0, 8 if seed < met else 20, seed < met),
        )
        write_record(record, record_path(tmp_path / "records", "clbench/Even-v1", "sft", seed))
    text = page()
    (sentence,) = re.findall(r"On Even-v1, plain fine-tuning loses a skill in 3 of 3 seeds(.*)", text)
    assert sentence.endswith(words)
    assert cells_of(text, "| Even-v1 | `skill_1`")[3] == f"{3 - met} of 3 seeds"
    assert "If the policy never meets the criterion again, the full budget of a stage counts." in text


def keep_demonstrations(records: Path) -> None:
    """Let experience replay keep prior demonstrations between the stages of its records."""
    for path in records.rglob("experience_replay/*.json"):
        values = json.loads(path.read_text(encoding="utf-8"))
        values["costs"]["bytes_kept"] = 1000
        values["run"]["uses"]["demonstrations"] = "throughout"
        path.write_text(json.dumps(sealed(values)), encoding="utf-8")


@pytest.mark.long
@pytest.mark.parametrize(("kept", "certain"), [(0.5, False), (0.9, True)])
def test_a_gain_of_replay_is_certain_only_if_the_test_tells_it_apart(
    kept: float, certain: bool, even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    for seed, luck in enumerate((0.02, -0.02, 0.06, -0.02)):
        even_board("sft", seed, 0.4)
        records = even_board("experience_replay", seed, kept + luck)
    keep_demonstrations(records)
    text = page()
    gain = cells_of(text, "| Even-v1 | `experience_replay`")[2]
    assert re.match(r"0\.\d+ \[0\.(?!00)", gain), "its own interval is above 0"
    assert ("not certain" not in gain) == certain
    assert f"In {int(certain)} of 1 comparison, a method that reads prior demonstrations" in text


@pytest.mark.long
def test_definitions_that_order_the_methods_alike_have_a_tau_of_one(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    fill(even_board, sft=0.2, finch=0.6, lora=0.4, l2_sp=0.1, stop_gradient=0.3, aegis=0.5)
    text = page()
    assert cells_of(text, "| Even-v1 | 1.00 |")[2] == "1.00"
    assert "these figures describe the board, and are not a test." in text
    alike = "1.00, p = 0.0012, 6 methods"
    # every seed is the same: the method explains all
    assert f"| Even-v1 | {alike} | {alike} | 100% | 0% |\n" in text
    assert (
        "order of the methods more than chance would explain on 1 of 1 scenario with enough methods.\n"
        in text
    )


def test_boards_with_a_fixed_number_of_steps_also_tell_what_is_lost_of_skills_and_knowledge(
    add_full: Callable[..., Path], tmp_path: Path
) -> None:
    for seed in range(2):
        add_full("sft", seed)
        add_full("frozen", seed)
    output = tmp_path / "findings.md"
    findings(records=tmp_path / "leaderboard/records", controls=tmp_path / "controls", output=output)
    section = output.read_text(encoding="utf-8").partition("## Are skills and knowledge lost together?")[2]
    assert "- Where stages have a fixed length, success on the skills falls by up to 0.00 (Toy-v0)" in section
    assert re.search(r"\| Toy-v0 \| of a fixed length \| .* \| 0\.\d\d .* to 0\.50 ", section)  # 25 of 50


@pytest.mark.long
def test_a_second_call_changes_no_byte(
    even_board: Callable[..., Path], page: Callable[[], str], tmp_path: Path
) -> None:
    fill(even_board, sft=0.2, finch=0.6)
    page()
    made = {path: path.read_bytes() for path in (tmp_path / "docs").rglob("*.*")}
    assert {path.name for path in made} == {"findings.md", "gains.svg", "gains-dark.svg"}
    page()
    assert {path: path.read_bytes() for path in (tmp_path / "docs").rglob("*.*")} == made


def test_without_records_at_equal_learning_there_is_nothing_to_say(
    four_methods: Path, tmp_path: Path
) -> None:
    output = tmp_path / "findings.md"
    findings(records=four_methods, controls=tmp_path / "controls", output=output)
    text = output.read_text(encoding="utf-8")
    assert "without prior demonstrations beat" not in text
    assert not (tmp_path / "findings").exists()


def test_a_board_without_plain_fine_tuning_compares_nothing_with_it(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    fill(even_board, l2_sp=0.4)
    text = page()
    assert "plain fine-tuning on" not in text
    assert "order the methods alike" not in text


def test_boards_that_share_no_order_of_methods_are_not_compared(
    even_board: Callable[..., Path],
    make_record: Callable[..., Record],
    tmp_path: Path,
    page: Callable[[], str],
) -> None:
    fill(even_board, l2_sp=0.4)
    for seed in range(4):
        for method in ("sft", "l2_sp"):
            one_target = [[1, 1, 0, 0], [0.5, 1, 0.9, 0]]
            options = {"scenario": "clbench/Single-v1", "steps": (20,), "ends": (8,)}
            record = make_record(one_target, method=method, seed=seed, **options)
            write_record(record, record_path(tmp_path / "records", "clbench/Single-v1", method, seed))
    text = page()
    assert "On Single-v1, no method is above plain fine-tuning and told apart from it." in text
    assert "Even-v1 and Single-v1" not in text


def test_without_retained_skills_no_loss_of_skills_is_told(
    make_record: Callable[..., Record], tmp_path: Path, page: Callable[[], str]
) -> None:
    for method, lost in (("sft", 10), ("frozen", 0)):
        answers = {(stage, "left"): (50, 45 - stage * lost) for stage in range(3)}
        for seed in range(2):
            success = [[0, 0, 0], [0.9, 0, 0], [0.9, 0.9, 0]]
            record = make_record(success, method=method, seed=seed, groups=(0, 2, 1), answers=answers)
            write_record(record, record_path(tmp_path / "records", "clbench/Toy-v0", method, seed))
    section = page().partition("## Are skills and knowledge lost together?")[2].partition("| scenario")[0]
    said = "- Where stages have a fixed length, the share of correct answers falls by up to 0.40 (Toy-v0)."
    assert section.strip() == said


def test_colour_is_not_the_only_sign_of_a_division_in_the_picture_of_the_gains(
    even_board: Callable[..., Path], page: Callable[[], str], tmp_path: Path
) -> None:
    for method in ("sft", "finch", "experience_replay"):
        records = even_board(method, 0, 0.4)
    keep_demonstrations(records)
    page()
    svg = (tmp_path / "docs/findings/gains.svg").read_text(encoding="utf-8")
    marks = re.findall(r'aria-roledescription="point"[^>]* d="(.*?)"', svg)
    assert len(marks) == len(set(marks)) == 2


def test_what_rises_falls_by_nothing(
    make_record: Callable[..., Record], tmp_path: Path, page: Callable[[], str]
) -> None:
    for method, more in (("sft", 1), ("frozen", 0)):
        answers = {(stage, "left"): (50, 45 + stage * more) for stage in range(2)}
        success = [[0.5, 0, 0, 0], [0.5 + more / 2, 0, 0, 0]]
        record = make_record(success, method=method, groups=(1, 1, 2), answers=answers)
        write_record(record, record_path(tmp_path / "records", "clbench/Toy-v0", method, 0))
    section = page().partition("## Are skills and knowledge lost together?")[2]
    assert "falls by up to 0.00 (Toy-v0), and the share of correct answers by up to 0.00 (Toy-v0)" in section


def test_a_single_seed_has_no_interval_in_any_section_and_picture(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    for method, kept in (("sft", 0.4), ("finch", 0.8), ("experience_replay", 0.9)):
        records = even_board(method, 0, kept)
    for factor in (1.0, 0.1):
        even_board("sft", 0, 0.4, "ladder", step_factor=factor)
    keep_demonstrations(records)
    text = page()
    assert cells_of(text, "| Even-v1 | 1 method, 1 seed")[2].startswith("`finch` 0.300 (50%")
    assert not re.search(r"\d \[-?\d", text)
    rows = resolve("clbench.leaderboard.board.rows:compute_board")(records).rows
    (panel,) = resolve("clbench.leaderboard.pages.findings_charts:gains_chart")({"Even-v1": rows})["vconcat"]
    assert all(one["low"] == one["value"] == one["high"] for one in panel["data"]["values"])
