"""The page of the claims: every verdict follows from records by its rule, and no input breaks it."""

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import sealed

from clbench.base.entry_points import resolve
from clbench.records.paths import label_of, record_path
from clbench.records.record import AnswerRow, Record
from clbench.records.writer import write_record

SCENARIO = "clbench/Toy-v0"
IDS = [*(f"C{number}" for number in range(1, 9)), *(f"A{number}" for number in range(1, 8))]
IDS += [f"F{number}" for number in range(1, 6)]


class Bench:
    """Folders of records, and the page made from them."""

    def __init__(self, folder: Path, make_record: Callable[..., Record]) -> None:
        self.folder = folder
        self.make_record = make_record

    def add(
        self,
        label: str,
        *,
        seeds: int = 3,
        kept: Any = 0.2,
        earlier: float = 1.0,
        curve: float = 0.5,
        took: tuple[int, int] | None = None,
        right: tuple[int, int] = (500, 400),
        sparsity: Any = 0.5,
        drift: Any = 1.0,
        costs: dict[str, Any] | None = None,
        diagnostics: dict[str, Any] | None = None,
        edit: Callable[[Record], None] | None = None,
    ) -> None:
        """Add the records of a method, or of changed settings of one.

        Args:
            label: Name with changed settings, such as "lora", "lora+rank=4" or "sft@0.3" of the ladder.
            seeds: Number of seeds.
            kept: Success on the two skills at the end, a number or one for each seed; it is 1 before.
            earlier: Success on the first target at the end.
            curve: Success on a target on the way.
            took: Steps of each stage to the criterion; stages are equally long if None.
            right: Questions of 500 answered rightly at the start and at the end.
            sparsity: Update sparsity at all points, a number or one for each seed.
            drift: Activation drift, likewise.
            costs: Fields of `Record.costs` that differ.
            diagnostics: `Record.diagnostics`.
            edit: Changes each record before it is written.
        """
        name, _, factor = label.partition("@")
        method, *changes = name.split("+")
        changed: dict[str, Any] = dict(change.split("=") for change in changes)
        if factor:
            changed["step_factor"] = float(factor)
        for seed in range(seeds):
            left = float(np.broadcast_to(kept, seeds)[seed])
            shape = (2, 1) if took else (2, 2)
            on_the_way = (
                {}
                if took
                else {"curves": np.full((2, 1), curve), "retained_curves": np.full((2, 1, 2), left)}
            )
            record = self.make_record(
                [[1, 1, 0, 0, 0], [1, left, 1, 0, 0], [left, left, earlier, 1, 0]],
                groups=(2, 2, 1),
                steps=(100,) if took else (50, 100),
                ends=took,
                validation=None if took else np.ones((2, 2)),
                sparsity=np.full(shape, np.broadcast_to(sparsity, seeds)[seed]),
                drift=np.full(shape, np.broadcast_to(drift, seeds)[seed]),
                answers={
                    (0, "left"): (500, right[0]),
                    (1, "left"): (500, right[1]),
                    (2, "left"): (500, right[1]),
                },
                method=method,
                seed=seed,
                changes=changed,
                settings=changed,
                **on_the_way,
            )
            record.costs = dataclasses.replace(record.costs, **(costs or {}))
            record.diagnostics.update(diagnostics or {})
            if edit:
                edit(record)
            path = record_path(self.folder / self.kind(label), SCENARIO, label_of(method, changed), seed)
            write_record(record, path)

    def kind(self, label: str) -> str:
        return "ladder" if "@" in label else "controls" if "+" in label else "records"

    def step_times(self, **ratios: float) -> None:
        """Leave what the speed benchmark leaves."""
        entries = {
            method: {"median_ratio": ratio, "low": ratio - 0.01, "high": ratio + 0.01}
            for method, ratio in ratios.items()
        }
        (self.folder / "step_time.json").write_text(json.dumps({"ratios": entries}), encoding="utf-8")

    def page(self) -> str:
        """Return the page."""
        output = self.folder / "docs" / "claims.md"
        resolve("clbench.leaderboard.cli:claims")(
            records=self.folder / "records",
            controls=self.folder / "controls",
            step_time=self.folder / "step_time.json",
            scenario=SCENARIO,
            output=output,
        )
        return output.read_text(encoding="utf-8")


@pytest.fixture
def bench(tmp_path: Path, make_record: Callable[..., Record]) -> Bench:
    return Bench(tmp_path, make_record)


def verdicts(page: str) -> dict[str, str]:
    """Return the verdicts in the table at the top."""
    return {
        line.split("]")[0][3:]: line.split(" | ")[3] for line in page.splitlines() if line.startswith("| [")
    }


def section(page: str, identifier: str) -> str:
    """Return the page's text on a claim, without the backslashes of Markdown."""
    found = re.search(rf"^### {identifier}\n(.*?)(?=^#|\Z)", page, re.MULTILINE | re.DOTALL)
    assert found
    return found[1].replace("\\", "")


Given = dict[str, dict[str, Any]]

SFT: Given = {"sft": {}, "sft@1": {}}
"""Plain fine-tuning that keeps .2 of the skills, at its best step size and at the published one."""
ACTIVE = {"1": {"omega_counts": [[5, 5], [5, 5]]}}
AT_FLOOR = {"1": {"omega_counts": [[99, 1], [100, 0]]}}
STEADY: Given = {"sft@1": {"took": (20, 20)}, "co_training+step_factor=1.0": {"took": (12, 12)}}
"""The auxiliary objective saves steps, so that there is a capability for a vector to carry."""
VECTOR, AT_RANDOM = "fast_dvla@1", "fast_dvla+direction=random+step_factor=1.0"
NO_REGULARISER = "fast_dvla+orthogonal=0.0+step_factor=1.0"
LOSES: Given = {"sft": {"right": (500, 400)}, "frozen": {"right": (500, 500)}}
"""Plain fine-tuning forgets a fifth of the answers."""
KEEPS: Given = {"sft": {"right": (500, 500)}, "frozen": {"right": (500, 500)}}


def _early_loss(record: Record) -> None:
    """Let the policy have lost the answers half way through the first stage."""
    record.add_answers(AnswerRow(1, 50, "left", 500, 400))


def _shed(first: float, later: float) -> Callable[[Record], None]:
    """Return the edit that writes the mean energy shed in the first stage and in the second."""

    def edit(record: Record) -> None:
        for stage, value in (("1", first), ("2", later)):
            record.diagnostics[stage] = {"energy_shed_mean": value + 0.001 * record.run.seed}

    return edit


CASES: list[tuple[str, str, Given]] = [
    ("C1", "holds", {"sft": {"kept": 0.2}}),
    ("C1", "does not hold", {"sft": {"kept": 1.0}}),
    ("C1", "undecided", {"sft": {"kept": 0.95}}),
    ("C2", "holds", {**SFT, "consft": {"kept": 0.8}, "consft_calibrated": {}}),
    (
        "C2",
        "does not hold",
        {**SFT, "consft": {}, "consft_calibrated": {}, "consft@1": {}, "consft_calibrated@1": {}},
    ),
    (
        "C2",
        "holds in part",
        {**SFT, "consft": {}, "consft_calibrated": {}, "consft@1": {}, "consft_calibrated@1": {"kept": 0.8}},
    ),
    ("C2", "undecided", {**SFT, "consft": {"kept": (0.0, 0.4, 0.8)}, "consft_calibrated": {}}),
    ("C2", "undecided", {"sft": {}, "consft": {}}),
    (
        "C2",
        "cannot be shown here",
        {
            "sft": {"kept": 0.95},
            "sft@1": {"kept": 0.95},
            "consft": {"kept": 1.0},
            "consft_calibrated": {"kept": 1.0},
        },
    ),
    (
        "C2",
        "cannot be shown here",
        {
            **SFT,
            "consft": {"kept": 0.8, "diagnostics": AT_FLOOR},
            "consft_calibrated": {"kept": 0.8, "diagnostics": AT_FLOOR},
        },
    ),
    (
        "C2",
        "undecided",
        {
            **SFT,
            "consft": {"kept": 0.8, "diagnostics": AT_FLOOR},
            "consft_calibrated": {"diagnostics": ACTIVE},
        },
    ),
    (
        "C3",
        "holds",
        {
            "consft": {"kept": 1.0},
            "consft_calibrated": {},
            "experience_replay": {"kept": 1.0},
            "buffered_replay": {"kept": 1.0},
        },
    ),
    (
        "C3",
        "does not hold",
        {"consft": {}, "consft_calibrated": {}, "experience_replay": {"kept": 1.0}, "buffered_replay": {}},
    ),
    ("C3", "undecided", {"consft": {"kept": 1.0}, "consft_calibrated": {}, "experience_replay": {}}),
    (
        "C4",
        "holds",
        {
            "sft@0.03": {"sparsity": 0.9},
            "sft@1": {"sparsity": 0.3},
            "sft": {"sparsity": 0.3},
            "consft": {"sparsity": 0.5},
        },
    ),
    (
        "C4",
        "does not hold",
        {
            "sft@0.03": {"sparsity": 0.9},
            "sft@1": {"sparsity": 0.3},
            "sft": {"sparsity": 0.3},
            "consft": {"sparsity": 0.3},
            "consft_calibrated": {"sparsity": 0.3},
        },
    ),
    (
        "C4",
        "cannot be shown here",
        {
            "sft@0.03": {"sparsity": 0.3},
            "sft@1": {"sparsity": 0.3},
            "sft": {"sparsity": 0.3},
            "consft": {"sparsity": 0.5},
        },
    ),
    ("C4", "undecided", {"sft": {"sparsity": 0.3, "seeds": 1}, "consft": {"sparsity": 0.9, "seeds": 1}}),
    ("C6", "does not hold", {"sft": {}, "consft": {"costs": {"bytes_kept": 8}}}),
    ("C6", "undecided", {"sft": {}, "consft": {}}),
    ("C7", "holds", {"consft": {"earlier": 1.0}, "consft_calibrated": {"earlier": 0.4}}),
    ("C7", "does not hold", {"consft": {"earlier": 0.5}, "consft_calibrated": {"earlier": 0.4}}),
    ("A1", "holds", {"sft": {"right": (500, 400), "edit": _early_loss}}),
    ("A1", "holds in part", LOSES),
    ("A1", "does not hold", KEEPS),
    ("A1", "undecided", {"sft": {"right": (490, 485)}}),
    ("A2", "holds", {**LOSES, "stop_gradient": {"right": (500, 500), "curve": 0.1}}),
    ("A2", "does not hold", {**LOSES, "stop_gradient": {"right": (500, 500)}}),
    ("A2", "does not hold", {**LOSES, "stop_gradient": {"right": (490, 300), "curve": 0.1}}),
    ("A2", "cannot be shown here", {**KEEPS, "stop_gradient": {"right": (500, 500), "curve": 0.1}}),
    ("A2", "undecided", {"stop_gradient": {"right": (500, 500), "curve": 0.1}}),
    ("A3", "holds", {**LOSES, "lora": {}, "lora+rank=4": {}, "lora+rank=64": {}}),
    ("A3", "holds in part", {**LOSES, "lora": {}, "lora+rank=4": {"right": (500, 500)}, "lora+rank=64": {}}),
    (
        "A3",
        "does not hold",
        {
            "frozen": {"right": (500, 500), "kept": 0.2},
            "lora": {"right": (500, 500)},
            "lora+rank=4": {"right": (500, 500)},
            "lora+rank=64": {"right": (500, 500)},
        },
    ),
    ("A3", "undecided", {"lora": {}}),
    ("A4", "holds", {**LOSES, "aegis": {"right": (500, 500)}}),
    ("A4", "does not hold", {**LOSES, "aegis": {"right": (500, 450)}}),
    ("A4", "cannot be shown here", {**KEEPS, "aegis": {"right": (500, 500)}}),
    ("A4", "undecided", {**LOSES, "frozen": {"right": (500, 490)}, "aegis": {"right": (500, 486)}}),
    ("A5", "holds", {"aegis": {"edit": _shed(0.002, 0.06)}}),
    ("A5", "does not hold", {"aegis": {"edit": _shed(0.06, 0.002)}}),
    ("A5", "undecided", {"aegis": {"edit": _shed(0.009, 0.002)}}),
    ("A5", "undecided", {"aegis": {"diagnostics": {"1": {"energy_shed_mean": "little"}}}}),
    ("A6", "holds", {"sft": {"drift": (8, 9, 10)}, "aegis": {"drift": 1.0}}),
    ("A6", "does not hold", {"sft": {"drift": (8, 9, 10)}, "aegis": {"drift": 7.0}}),
    ("A6", "undecided", {"sft": {"drift": 0.0}, "aegis": {"drift": 1.0}}),
    ("F1", "holds in part", STEADY),
    ("F1", "undecided", {"sft@1": {"took": (20, 20)}}),
    ("F2", "holds", {**STEADY, VECTOR: {"took": (10, 10)}, AT_RANDOM: {"took": (20, 20)}}),
    ("F2", "does not hold", {**STEADY, VECTOR: {"took": (10, 10)}, AT_RANDOM: {"took": (10, 10)}}),
    (
        "F2",
        "cannot be shown here",
        {**STEADY, "co_training+step_factor=1.0": {"took": (20, 20)}, VECTOR: {"took": (10, 10)}},
    ),
    ("F2", "undecided", {**STEADY, VECTOR: {"took": (10, 10)}}),
    ("F3", "holds", {**STEADY, VECTOR: {"took": (10, 10)}, NO_REGULARISER: {"took": (12, 12)}}),
    ("F3", "does not hold", {**STEADY, VECTOR: {"took": (12, 12)}, NO_REGULARISER: {"took": (12, 12)}}),
    ("F5", "holds", {**STEADY, VECTOR: {"took": (10, 10)}, AT_RANDOM: {"took": (12, 12)}}),
    ("F5", "does not hold", {**STEADY, VECTOR: {"took": (12, 12)}, AT_RANDOM: {"took": (10, 10)}}),
]


@pytest.mark.parametrize(
    ("identifier", "verdict", "given"),
    CASES,
    ids=[f"{identifier}-{verdict}-{number}" for number, (identifier, verdict, _) in enumerate(CASES)],
)
def test_a_verdict_follows_from_the_records_by_the_rule(
    identifier: str, verdict: str, given: Given, bench: Bench
) -> None:
    for label, values in given.items():
        bench.add(label, **values)
    assert verdicts(bench.page())[identifier] == verdict


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
        bench.step_times(**{method: limit + ratio})
        page = bench.page()
        assert verdicts(page)[identifier] == verdict
    assert f"| {limit + 0.02:.2f} [{limit + 0.01:.2f}, {limit + 0.03:.2f}] |" in section(page, identifier)
    assert f"would have to move by 0.01 to reach {limit:.2f}." in section(page, identifier)


@pytest.mark.parametrize(
    "content", ["", "[]", "{", '{"ratios": 3}', '{"ratios": {"aegis": {"median_ratio": NaN}}}']
)
def test_a_torn_file_of_step_times_counts_as_missing(content: str, bench: Bench) -> None:
    (bench.folder / "step_time.json").write_text(content, encoding="utf-8")
    assert verdicts(bench.page())["A7"] == "undecided"


def test_without_any_record_every_claim_says_which_command_is_missing(bench: Bench) -> None:
    page = bench.page()
    assert list(verdicts(page)) == IDS
    others = {"C5": "holds", "C8": "cannot be shown here"}
    assert verdicts(page) == {identifier: others.get(identifier, "undecided") for identifier in IDS}
    for identifier in IDS:
        assert "clbench run" in section(page, identifier) or identifier == "C8"
    sft_on_the_ladder = f"`clbench run {SCENARIO} sft --set.step_factor 1 --records leaderboard/ladder`"
    assert sft_on_the_ladder in section(page, "C2")
    assert f"`clbench run {SCENARIO} aegis frozen sft`" in section(page, "A4")
    assert f"`clbench run {SCENARIO} aegis --set.direction random --records leaderboard/controls`" in section(
        page, "A4"
    )
    assert "Later work." in section(page, "F6")


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


def test_an_arm_with_all_weights_at_the_floor_does_not_count_and_the_page_says_so(bench: Bench) -> None:
    bench.add("sft")
    bench.add("sft@1")
    bench.add("consft", kept=0.8, diagnostics=AT_FLOOR)
    bench.add("consft_calibrated", diagnostics=ACTIVE)
    entry = section(bench.page(), "C2")
    assert "100% of the weights of consft are below 0.01: this arm is plain fine-tuning" in entry
    assert "weights of consft_calibrated are below" not in entry


def test_a_control_says_whether_it_explains_what_is_kept(bench: Bench) -> None:
    for label in ("sft", "sft@1", "finch"):
        bench.add(label)
    for method in ("consft", "consft_calibrated", "constant_weight"):
        bench.add(method, kept=0.9)
    entry = section(bench.page(), "C2")
    assert "constant_weight is not told apart from it" in entry
    assert "finch does not reach it: a step size that follows the loss does not suffice." in entry
    assert "The records cannot show what shuffled_weights says about it." in entry


def test_an_undecided_claim_says_how_many_seeds_would_decide(bench: Bench) -> None:
    bench.add("sft", kept=(0.85, 0.9, 0.95))
    entry = section(bench.page(), "C1")
    # the drop is .10, .05 above the bar; with 3 seeds the interval reaches 4.3 x .05 / sqrt(3) = .12
    found = re.search(r"At this spread about (\d+) seeds: .* contains 0.05", entry)
    assert found
    assert 10 <= int(found[1]) <= 30


def test_a_verdict_belongs_to_its_scenario(bench: Bench) -> None:
    bench.add("sft")
    output = bench.folder / "claims.md"
    resolve("clbench.leaderboard.cli:claims")(
        records=bench.folder / "records", controls=bench.folder / "controls", output=output
    )
    page = output.read_text(encoding="utf-8")
    rows = [line.split(" | ")[2:4] for line in page.splitlines() if line.startswith("| [C1]")]
    assert rows == [["clbench/Fetch-v1", "undecided"], ["clbench/MetaWorld-v1", "undecided"]]
    assert "clbench/FetchKnowledge-v1" in page


def test_a_seed_that_one_of_two_methods_lacks_is_left_out(bench: Bench) -> None:
    bench.add("sft", seeds=3)
    bench.add("stop_gradient", seeds=2, right=(490, 490))
    row = next(line for line in section(bench.page(), "A2").splitlines() if "evaluated steps, stop" in line)
    assert "| 0, 1 |" in row


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
    assert (
        "controls/Toy-v0/aegis+direction=random/seed-0.json" in section(page, "A4") or "budget differ" in page
    )


def test_records_among_the_controls_that_changed_nothing_are_left_out(bench: Bench) -> None:
    bench.add("sft")
    (bench.folder / "records").rename(bench.folder / "controls")
    page = bench.page()
    assert verdicts(page)["C1"] == "undecided"
    assert "no setting was changed" in page


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
    assert capsys.readouterr().out == printed
    assert str(bench.folder) not in first
    assert not re.search(r"\b20\d\d-\d\d", first)
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
