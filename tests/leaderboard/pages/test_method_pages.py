"""The pages of the methods: the same headings for each, all contents from the code and the records."""

import dataclasses
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clbench.base.entry_points import resolve
from clbench.learning.method import Method
from clbench.learning.prior import Uses
from clbench.learning.registry import load_method, method_names
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.runs.tuning import Tried, Tuned
from clbench.testing import TOY

SCENARIO = TOY.id
HEADINGS = [
    "Idea",
    "Paper",
    "Rule",
    "Stored",
    "Implementation details",
    "Hyper-parameters",
    "Diagnostics",
    "Results here",
    "Command",
]
BUILT_IN = [name for name in method_names() if "/" not in name]


class Bench:
    """Folders of records, and the pages made from them."""

    def __init__(self, folder: Path, make_record: Callable[..., Record]) -> None:
        self.folder = folder
        self.make_record = make_record

    def add(self, label: str, kept: float = 0.2, seed: int = 0, **values: Any) -> Record:
        """Add a record of a method, or of changed settings of one, and return it."""
        method, *changes = label.split("+")
        changed = {name: float(value) for name, value in (change.split("=") for change in changes)}
        fields = {"diagnostics": {}, "costs": {}, **values}
        record = self.make_record(
            [[1, 1, 0, 0, 0], [1, kept, 1, 0, 0], [kept, kept, 1, 1, 0]],
            groups=(2, 2, 1),
            steps=(50, 100),
            curves=np.full((2, 1), 0.5),
            retained_curves=np.full((2, 1, 2), kept),
            answers={(stage, "left"): (100, 90) for stage in range(3)},
            method=method,
            seed=seed,
            changes=changed,
            settings={**fields.pop("settings", {}), **changed},
        )
        record.costs = dataclasses.replace(record.costs, **fields["costs"])
        record.diagnostics.update(fields["diagnostics"])
        write_record(record, record_path(self.folder / "records", SCENARIO, label, seed))
        return record

    def add_to_criterion(self, method: str) -> None:
        """Add a record with stages to a criterion."""
        record = self.make_record(
            [[1, 1, 0, 0, 0], [1, 0.5, 1, 0, 0], [0.5, 0.5, 1, 1, 0]],
            groups=(2, 2, 1),
            steps=(20,),
            ends=(8, 20),
            method=method,
        )
        write_record(record, record_path(self.folder / "records", SCENARIO, method, 0))

    def pages(self) -> dict[str, str]:
        """Return the pages by the name of the method."""
        output = self.folder / "docs" / "methods"
        resolve("clbench.leaderboard.pages.cli:method_pages")(
            records=self.folder / "records",
            controls=self.folder / "controls",
            scenario=SCENARIO,
            output=output,
        )
        return {path.stem: path.read_text(encoding="utf-8") for path in output.iterdir()}


@pytest.fixture
def bench(tmp_path: Path, make_record: Callable[..., Record]) -> Bench:
    return Bench(tmp_path, make_record)


def part(page: str, heading: str) -> str:
    """Return the text under a heading, without the backslashes of Markdown."""
    found = re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    assert found
    return found[1].replace("\\", "").strip()


def test_every_installed_method_has_a_page_with_all_headings_in_order(bench: Bench) -> None:
    pages = bench.pages()
    assert sorted(pages) == sorted([*BUILT_IN, "README"])
    for name in BUILT_IN:
        assert re.findall(r"^## (.+)$", pages[name], re.MULTILINE) == HEADINGS
        for heading in HEADINGS:
            assert part(pages[name], heading)
        assert f"clbench run {SCENARIO} {name}" in part(pages[name], "Command")
        assert "It has no row on a board" in part(pages[name], "Results here")


def test_the_list_has_every_method_once_under_its_division(bench: Bench) -> None:
    contents = bench.pages()["README"]
    links = re.findall(r"^- \[.+\]\((\w+)\.md\): .+", contents, re.MULTILINE)
    assert sorted(links) == BUILT_IN
    for name, division in (("sft", "Prior-data-free"), ("aegis", "Prior questions"), ("joint", "Reference")):
        assert f"({name}.md)" in part(contents, division)


def test_every_hyper_parameter_has_its_default_and_its_meaning(bench: Bench) -> None:
    pages = bench.pages()
    for name in BUILT_IN:
        text = part(pages[name], "Hyper-parameters")
        for field in dataclasses.fields(load_method(name)):
            if field.name == "step_factor":  # the same for every method: the list of methods has it once
                assert "| `step_factor`" not in text
                continue
            assert re.search(rf"\| `{field.name}` \| `{re.escape(repr(field.default))}` \| \w", text)
        assert text.startswith(("None of its own.", "| name | default | meaning |"))
    assert "| `step_factor` | `1.0` | Factor of the" in part(
        pages["README"], "Hyper-parameters of every method"
    )


def test_a_docstring_is_taken_apart_into_idea_rule_and_details(bench: Bench) -> None:
    page = bench.pages()["aegis"]
    link = "[arXiv 2604.16067](https://arxiv.org/abs/2604.16067)"
    assert part(page, "Idea").startswith("AEGIS: the backbone's gradient must not move its hidden states")
    assert link in part(page, "Idea")
    assert part(page, "Paper") == f"{link}."
    assert part(page, "Rule").startswith("Before training, the pretrained policy reads questions.")
    assert '`direction="random"` is the control' in part(page, "Rule").splitlines()[-1]
    details = part(page, "Implementation details").splitlines()
    assert [line.partition(".")[0] for line in details] == [
        str(number) for number in range(1, len(details) + 1)
    ]
    assert "Details:" not in page


def test_a_paper_that_is_named_over_a_line_break_is_a_link(bench: Bench) -> None:
    assert "In the details: [arXiv 2604.16067]" in part(bench.pages()["lora"], "Paper")


def test_a_subclass_takes_the_docstring_and_has_its_own_defaults(bench: Bench) -> None:
    pages = bench.pages()
    for heading in ("Rule", "Implementation details", "Paper"):
        assert part(pages["consft_calibrated"], heading) == part(pages["consft"], heading)
    default = load_method("consft_calibrated").__dataclass_fields__["loss_scale"].default
    row = f"| `loss_scale` | `{default}` | Factor that converts the policy's loss to the unit"
    assert row in part(pages["consft_calibrated"], "Hyper-parameters")
    assert "`kappa`" in part(pages["consft_calibrated"], "Hyper-parameters")


def test_the_stored_data_come_from_the_declaration_and_the_records(bench: Bench) -> None:
    for seed in range(2):
        bench.add("ewc", seed=seed, costs={"bytes_kept": 8000, "parameters_added": 12})
    stored = part(bench.pages()["ewc"], "Stored")
    assert "It reads prior demonstrations only before the first target." in stored
    assert "It never uses prior questions." in stored
    assert "Division: prior demonstrations." in stored
    assert "Bytes kept on clbench/Toy-v0: 8,000." in stored
    assert "Parameters added on clbench/Toy-v0: 12." in stored


@pytest.mark.long
def test_the_row_of_the_board_is_next_to_three_others(bench: Bench) -> None:
    for method in ("consft", "sft", "experience_replay", "frozen"):
        for seed in range(2):
            bench.add(method, kept={"consft": 0.6, "sft": 0.2}.get(method, 1.0), seed=seed)
    results = part(bench.pages()["consft"], "Results here")
    assert "|  | consft | sft | experience_replay | frozen |" in results
    row = next(line for line in results.splitlines() if line.startswith("| retention |"))
    assert [re.sub(r" \[.*?\]", "", cell) for cell in row.strip("| ").split(" | ")] == [
        "retention",
        "0.60",
        "0.20",
        "1.00",
        "1.00",
    ]
    assert "| seeds | 2 | 2 | 2 | 2 |" in results


@pytest.mark.long
def test_the_command_makes_the_row_with_all_its_seeds_and_perturbed_worlds(bench: Bench) -> None:
    for seed in range(3):
        bench.add("finch", seed=seed)
        bench.add("lora", seed=seed + 2)
    pages = bench.pages()
    assert f"clbench run {SCENARIO} finch --seeds 3\n" in part(pages["finch"], "Command")
    assert f"clbench run {SCENARIO} lora --seeds 3 --first-seed 2\n" in part(pages["lora"], "Command")
    assert f"clbench run {SCENARIO} ewc\n" in part(pages["ewc"], "Command")


@pytest.mark.long
def test_the_claims_on_a_method_are_linked_with_their_verdicts(bench: Bench) -> None:
    for seed in range(2):
        bench.add("sft", seed=seed)
    pages = bench.pages()
    boards = ("Fetch-v1", "MetaWorld-v1", "PointMaze-v1", "LiberoSpatial-v1")
    all_of_them = ", ".join(f"undecided ({scenario})" for scenario in boards)
    assert f"- [C1](../claims.md#c1), {all_of_them}: Unconstrained" in part(pages["sft"], "Results here")
    for identifier in ("C2", "C5", "C8"):
        assert f"[{identifier}](../claims.md#{identifier.lower()})" in part(pages["consft"], "Results here")
    section = part(pages["constant_weight"], "Results here")
    assert "[C2]" in section
    assert "(Comparison only.)" in next(line for line in section.splitlines() if "[C2]" in line)
    assert "### Claims" not in pages["lwf"]


def test_scalar_diagnostics_are_averaged_over_stages_and_seeds(bench: Bench) -> None:
    for seed, shed in enumerate((0.019, 0.02, 0.021)):
        stages = {str(stage): {"energy_shed_mean": shed, "anchor_distance": [1.0]} for stage in (1, 2)}
        bench.add("aegis", seed=seed, diagnostics={"0": "none", **stages})
    section = part(bench.pages()["aegis"], "Diagnostics")
    assert section.startswith("How much was projected out")
    # Wilson's interval of a share, as on the page of claims; Student's would be [0.01752, 0.02248]
    assert "| energy_shed_mean | 0.02 [0.01766, 0.02264] |" in section
    assert "| anchor_distance" not in section


def test_the_settings_that_tuning_tried_are_listed_with_the_chosen_one(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = Tried({"step_factor": 1.0}, 0.36, 0.96), Tried({"step_factor": 0.055}, 0.61, 0.94)
    found = {"clbench/MetaWorld-v1": {"consft": Tuned({"step_factor": 0.055}, tried)}}
    monkeypatch.setattr(
        "clbench.leaderboard.pages.method_pages.tuned", lambda scenario: found.get(scenario, {})
    )
    pages = bench.pages()
    section = part(pages["consft"], "Results here").partition("### Settings tried")[2]
    assert [line for line in section.splitlines() if line.startswith("| clbench")] == [
        "| clbench/MetaWorld-v1 | step_factor = 1 | 0.96 | 0.360 |  |",
        "| clbench/MetaWorld-v1 | step_factor = 0.055 | 0.94 | 0.610 | yes |",
    ]
    command = "clbench tune clbench/MetaWorld-v1 consft --write methods/tuned/MetaWorld-v1.json"
    assert command in part(pages["consft"], "Command")
    chosen = "Tuning chose `step_factor` = 0.055 on clbench/MetaWorld-v1."
    assert part(pages["consft"], "Hyper-parameters").endswith(chosen)
    assert "Tuning chose" not in pages["ewc"]
    assert "Settings tried" not in pages["ewc"]
    assert "clbench tune" not in part(pages["ewc"], "Command")


def test_steps_and_speed_are_shown_with_the_learning_rates_that_they_follow_from(bench: Bench) -> None:
    rates = {"sft": 0.3, "fast_dvla": 0.03, "consft": 0.3, "frozen": 1.0}
    for method in rates:
        bench.add_to_criterion(method)
    rows = resolve("clbench.leaderboard.board.rows:compute_board")(bench.folder / "records").rows
    for row in rows:  # as tuning would have chosen them
        row.runs[0].record.run.settings["step_factor"] = rates[row.method]
    results = results_of(rows)
    sentence = (
        "Steps and speed also depend on the learning rate: `step_factor` is 0.03 for `fast_dvla` and 0.3 "
        "for `sft`."
    )
    assert sentence in results["fast_dvla"].splitlines()
    for method in ("consft", "sft", "frozen"):  # the same rate, sft itself, and a policy that is not trained
        assert "| steps to criterion |" in results[method]
        assert "follow from" not in results[method]
    alone = results_of([row for row in rows if row.method != "sft"])["fast_dvla"]
    assert "| steps to criterion |" in alone
    assert "follow from" not in alone


def results_of(rows: Any) -> dict[str, str]:
    """Return the results on the pages that are made from rows of the board alone, by method."""
    evidence = resolve("clbench.leaderboard.claims.evidence:Evidence")(SCENARIO, {}, ())
    sources = resolve("clbench.leaderboard.pages.method_pages:Sources")(evidence, [], rows)
    methods = resolve("clbench.leaderboard.views.descriptions:built_in_descriptions")()
    pages = resolve("clbench.leaderboard.pages.method_pages:pages")(methods, sources)
    return {one.name: part(pages[f"{one.name}.md"], "Results here") for one in methods}


NO_TIE: dict[str, Any] = {
    "settings": {"step_factor": 0.3},
    "tried": (
        Tried({"step_factor": 1.0}, 0.57, 0.9),
        Tried({"step_factor": 0.3}, 0.58, 0.9),
        Tried({"step_factor": 0.1}, 0.56, 0.9),
    ),
}
"""What tuning of plain fine-tuning found: neither a tie, nor an end of the range."""


def test_a_setting_that_ties_with_the_chosen_one_is_told(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = {1.0: (0.58, 0.94), 0.3: (0.57, 0.94), 0.1: (0.58, 0.81), 0.03: (0.58, 0.79)}
    tried = tuple(Tried({"kappa": 0.3, "step_factor": factor}, *score) for factor, score in scores.items())
    found = {"clbench/MetaWorld-v1": {"finch": Tuned(tried[0].settings, tried), "sft": Tuned(**NO_TIE)}}
    monkeypatch.setattr(
        "clbench.leaderboard.pages.method_pages.tuned", lambda scenario: found.get(scenario, {})
    )
    pages = bench.pages()
    assert [line for line in pages["finch"].splitlines() if " ties " in line] == [
        "On clbench/MetaWorld-v1, `kappa` = 0.3, `step_factor` = 0.1 ties with the chosen setting but was "
        "tried later, so it has no row on the board."
    ]
    assert " ties " not in pages["sft"]


def test_a_chosen_learning_rate_at_an_end_of_those_tried_is_told(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def tuned(*scores: float) -> Tuned:
        tried = [Tried({"step_factor": 10.0**-place}, score, 0.9) for place, score in enumerate(scores)]
        return Tuned(max(tried, key=lambda one: one.final_average or 0.0).settings, tuple(tried))

    found = {
        "clbench/Fetch-v1": {"a_gem": tuned(0.5, 0.6, 0.7), "sft": tuned(0.6, 0.7, 0.5)},
        "clbench/MetaWorld-v1": {"a_gem": tuned(0.7, 0.6, 0.5), "ewc": tuned(0.7, 0.6)},
        "clbench/PointMaze-v1": {"a_gem": tuned(0.5, 0.7, 0.8), "sft": tuned(0.6)},
    }
    monkeypatch.setattr(
        "clbench.leaderboard.pages.method_pages.tuned", lambda scenario: found.get(scenario, {})
    )
    pages = bench.pages()
    told = {
        name: [line for line in page.splitlines() if line.startswith("The chosen learning rate")]
        for name, page in pages.items()
    }
    ends = (
        "the smallest tried on clbench/Fetch-v1 and clbench/PointMaze-v1 and the largest tried on "
        "clbench/MetaWorld-v1"
    )
    assert told["a_gem"] == [f"The chosen learning rate is {ends}; a wider range might contain a better one."]
    assert len(told["ewc"]) == 1
    assert told["sft"] == told["consft"] == []  # between two others or the only one; not tuned


def test_the_tuned_files_have_the_ties_and_ends_that_the_protocol_counts(bench: Bench) -> None:
    pages = bench.pages()
    ties = sorted(name for name, page in pages.items() for _ in re.findall(" ties with ", page))
    assert ties == ["finch", "finch", "lora", "sft", "stop_gradient"]
    told = [line for page in pages.values() for line in page.splitlines() if "a wider range might" in line]
    boards = [name for line in told for name in re.findall(r"clbench/(\w+-v1)", line)]
    assert len([name for name in boards if name != "LiberoSpatial-v1"]) == 18


def test_a_control_names_the_method_whose_settings_it_has_and_lists_none_of_its_trials(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    tuned = Tuned({"loss_scale": 0.01}, (Tried({"loss_scale": 0.01}, 0.61, 0.94),))
    found = {"consft_calibrated": tuned, "constant_weight": tuned}
    monkeypatch.setattr(
        "clbench.leaderboard.pages.method_pages.tuned",
        lambda scenario: found if scenario == "clbench/MetaWorld-v1" else {},
    )
    page = bench.pages()["constant_weight"]
    has = "It uses the settings that were tuned for `consft_calibrated`: `loss_scale` = 0.01 on "
    assert part(page, "Hyper-parameters").endswith(f"{has}clbench/MetaWorld-v1.")
    assert "Settings tried" not in page
    assert "clbench tune clbench/MetaWorld-v1 consft_calibrated --write" in part(page, "Command")


def test_words_of_strangers_in_records_are_no_markup(bench: Bench) -> None:
    hostile = "x | y\n## z <b> ```"
    bench.add("aegis", diagnostics={"1": {hostile: 0.5}})
    page = bench.pages()["aegis"]
    assert re.findall(r"^## (.+)$", page, re.MULTILINE) == HEADINGS
    assert "<b>" not in page.replace("\\<", "").partition("```console")[0]
    assert len(re.findall("^```", page, re.MULTILINE)) == 2


@pytest.mark.long
def test_the_same_content_gives_the_same_bytes_and_no_place_or_date(bench: Bench) -> None:
    for method in ("sft", "consft", "aegis"):
        bench.add(method)
    first = bench.pages()
    assert bench.pages() == first
    for page in first.values():
        assert str(bench.folder) not in page
        assert not re.search(r"\b20\d\d-\d\d-\d\d", page)


@dataclass
class Toy(Method):
    """A method of this file."""

    first: float = 1.0
    """Of the two
    fields."""
    second: str = "x|y"

    uses = Uses(demonstrations="throughout")


@pytest.mark.parametrize(
    ("docstring", "idea", "rule", "details"),
    [
        ("Idea.", "Idea.", (), ()),
        ("Idea.\n\nOne\nline.\n\nTwo.", "Idea.", ("One line.", "Two."), ()),
        ("Idea.\n\nRule.\nDetails:\n1. One\n   more.\n2. Two.", "Idea.", ("Rule.",), ("One more.", "Two.")),
        ("Idea.\n\nDetails:\n1. One.\n\n2. Two.\n\nEnd\nof it.", "Idea.", ("End of it.",), ("One.", "Two.")),
        ("", "", (), ()),
    ],
)
def test_docstrings_of_any_shape_are_read(
    docstring: str, idea: str, rule: tuple[str, ...], details: tuple[str, ...]
) -> None:
    text = resolve("clbench.leaderboard.views.descriptions:read_docstring")(docstring)
    assert (text.idea, text.rule, text.details) == (idea, rule, details)


def test_fields_are_read_with_the_docstrings_under_them() -> None:
    described = resolve("clbench.leaderboard.views.descriptions:describe")("toy", Toy)
    assert [(one.name, one.default, one.meaning) for one in described.hyper_parameters] == [
        ("first", "1.0", "Of the two fields."),
        ("second", "'x|y'", ""),
    ]
    assert described.division == "prior demonstrations"
    assert described.summary == "A method of this file."
    assert described.hook("diagnostics") == []


def test_a_share_has_the_interval_that_it_has_on_the_page_of_the_claims(bench: Bench) -> None:
    for seed in range(3):
        shed = {"1": {"energy_shed_mean": 0.004 + 0.05 * (seed == 2)}}
        bench.add("aegis", seed=seed, diagnostics=shed)
    row = re.search(
        r"\| energy_shed_mean \| 0\.02067 \[(\S+), (\S+)\] \|", bench.pages()["aegis"].replace("\\", "")
    )
    assert row
    assert 0 < float(row[1]) < float(row[2]) < 1  # plain Student's would begin at -0.05
