"""Cards of scenarios: from the code, the records and kept measurements; they name missing parts."""

import dataclasses
import json
import re
from collections.abc import Callable, Iterable
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import complete_record, scenario_or_skip, sealed
from PIL import Image
from scipy import stats

from clbench.base.entry_points import resolve
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.runs.spec import RunSpec
from clbench.spec.registry import load_scenario
from clbench.testing import TOY

scenario_card = resolve("clbench.leaderboard.pages.cli:scenario_card")
spaces_of = resolve("clbench.leaderboard.pages.scenario_spaces:spaces_of")

GUIDES = Path(__file__).parents[3] / "docs" / "guide"
GROUPS = ("retained", "target", "held_out")
ONLINE = {"demonstrations": "never", "questions": "never", "reference": False, "online": True}
NAMES = [task.name for task in TOY.tasks]
KEEPS = [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 1, 1, 0]]
FORGETS = [[1, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0]]
STAYS = [[1, 1, 0, 0, 0]] * 3
SCRATCH = [[0, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0]]


class Bench:
    """A folder of records of the toy, and the card made from them."""

    def __init__(self, folder: Path, make_record: Callable[..., Record]) -> None:
        self.records, self.output, self.make_record = folder / "records", folder / "cards", make_record

    def add(
        self,
        method: str,
        success: Any,
        seeds: Iterable[int] = range(3),
        order: int = 0,
        online: bool = False,
    ) -> None:
        """Add records of a method that has a success rate on each task after each stage."""
        for seed in seeds:
            asked = {(stage, "side"): (100, 90) for stage in range(3)}
            record = self.make_record(
                success,
                groups=(2, 2, 1),
                episodes=TOY.budget.test_episodes,
                method=method,
                seed=seed,
                answers=asked,
                complete=False,
            )
            made = chain.from_iterable(getattr(record.scenario, group) for group in GROUPS)
            names = dict(zip(made, NAMES, strict=True))
            record.episodes["task"] = [names[name] for name in record.episodes["task"]]
            run = RunSpec("clbench.testing:clbench/Toy-v0", method, seed, order=order).resolve()
            record.run, record.scenario = run.info, run.scenario_info
            if online:
                record.run.uses = ONLINE
            steps = dict(zip((100, 200, 300, 400), (7, 15, 30, 60), strict=True))
            for table in (record.episodes, record.answers):
                table["step"] = [steps.get(step, step) for step in table["step"]]
            complete_record(record)
            write_record(record, run.path(self.records))

    def add_all(self) -> None:
        self.add("sft", FORGETS)
        self.add("joint", KEEPS)
        self.add("frozen", STAYS)
        self.add("from_scratch", SCRATCH)

    def card(self, *scenarios: str, **options: Any) -> str:
        """Return the card, without the backslashes of Markdown."""
        options = {"episodes": 3, "records": self.records, "output": self.output, **options}
        scenario_card(*(scenarios or (TOY.id,)), **options)
        return (self.output / "Toy-v0.md").read_text(encoding="utf-8").replace("\\", "")


@pytest.fixture
def bench(tmp_path: Path, make_record: Callable[..., Record], monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Return a bench with a renderer; MuJoCo's own is tested elsewhere, as it takes seconds."""
    monkeypatch.setenv("MUJOCO_GL", "egl")  # the choice ends with the test
    monkeypatch.setattr("clbench.worlds.gl_backend.rendering_fault", lambda *_: None)
    return Bench(tmp_path, make_record)


def part(card: str, heading: str) -> str:
    """Return the text under a heading."""
    found = re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", card, re.MULTILINE | re.DOTALL)
    assert found
    return found[1].strip()


def bars(card: str) -> dict[str, list[str]]:
    """Return the cells of each bar by its words."""
    rows = part(card, "Whether it tells methods apart").partition("| bar |")[2].splitlines()[2:]
    cells = [row.strip("| ").split(" | ") for row in rows if row.startswith("|")]
    return {words: rest for words, *rest in cells}


def test_every_task_has_its_group_picture_instructions_and_measured_expert(bench: Bench) -> None:
    tasks = part(bench.card(), "Tasks")
    assert re.findall(r"^\| (\w+) \| !\[", tasks, re.MULTILINE) == NAMES
    assert re.findall(r"^### (\w+)", tasks, re.MULTILINE) == ["Retained", "Targets", "Held"]
    assert "| left | ![left](Toy-v0/left.webp) | go left<br>move to the left | 1.00 | 12 |" in tasks
    kept = json.loads((bench.output / "Toy-v0" / "experts.json").read_text(encoding="utf-8"))
    assert kept["left"] == {"version": 0, "episodes": 3, "successes": 3}
    pictures = [np.asarray(Image.open(bench.output / "Toy-v0" / f"{name}.webp")) for name in NAMES]
    assert {picture.shape for picture in pictures} == {(240, 240, 3)}
    assert all(picture.max() > 200 for picture in pictures)  # the white point
    assert sum(path.stat().st_size for path in (bench.output / "Toy-v0").iterdir()) < 500_000


def test_a_card_has_the_shapes_and_the_words_of_the_world(bench: Bench) -> None:
    text = part(bench.card(), "States, actions and rewards")
    assert '| `observation["state"]` | (4,) |' in text
    assert "| `action` | (2,) | -1 to 1 |" in text
    assert "image" not in text
    assert "A task succeeds when the point has moved by 1 in the direction of the task" in text
    assert "About this world" not in text  # it is in no suite with a guide


@pytest.mark.parametrize(
    ("name", "size", "words"),
    [
        ("Fetch-v1", 28, "| 25 to 27 | Position of the target marker. |"),
        ("MetaWorld-v1", 39, "| 36 to 38 | Goal position of the object, or of the hand in a reach. |"),
        ("PointMaze-v1", 11, "| 2 to 3 | Velocity of the ball. |"),
        ("DMControl-v0", 19, "| 16 to 18 | One-hot code of the body, in the order of `BODIES`. |"),
    ],
)
def test_a_card_says_what_each_number_of_a_state_is(name: str, size: int, words: str, bench: Bench) -> None:
    spaces = spaces_of(scenario_or_skip(f"clbench/{name}"))
    places = [tuple(map(int, place.split(" to "))) for place, _ in spaces.parts]
    assert spaces.state_size == size
    assert all(first <= last < size for first, last in places)
    assert all(before[1] < after[0] for before, after in pairwise(places))  # in order, and none twice
    assert words in [f"| {place} | {meaning} |" for place, meaning in spaces.parts]
    assert any(re.search(r"action \(\d,\) in \[-1, 1\]", paragraph) for paragraph in spaces.words)
    assert spaces.guide is not None
    page, _, heading = spaces.guide.partition("#")
    titles = re.findall(r"^## (.*)$", (GUIDES / page).read_text(encoding="utf-8"), re.MULTILINE)
    assert not heading or heading in [title.lower() for title in titles]


def test_a_policy_with_a_camera_gets_the_numbers_that_the_camera_passes_on() -> None:
    spaces = spaces_of(load_scenario("clbench/FetchPixels-v0"))
    assert (spaces.image_size, spaces.state_size, spaces.parts) == (64, 10, ())
    assert "ten measurements of the robot" in spaces.words[-1]


def test_budget_and_questions_come_from_the_code(bench: Bench) -> None:
    card = bench.card()
    budget = part(card, "Budget")
    assert "| `pretraining_learning_rate` | Peak learning rate of pretraining. | 0.002 |" in budget
    assert "evaluated after 15, 30, 60 steps" in budget
    assert "| side | on which side of the target is it | left, right |" in part(card, "Questions")


def test_a_scenario_that_tells_methods_apart_holds_all_bars(bench: Bench) -> None:
    bench.add_all()
    found = bars(bench.card())
    assert list(found) == [
        "pretrained policy on the retained skills",
        "adaptation of sft",
        "retention of sft",
        "best final average (of frozen) minus that of joint",
        "adaptation of frozen",
    ]
    assert {verdict for *_, verdict in found.values()} == {"holds"}
    assert found["retention of sft"] == ["at most 0.50", "0.00 [0.00, 0.00]", "holds"]


@pytest.mark.parametrize(
    ("method", "success", "words"),
    [
        ("sft", [[1, 0.5, 0, 0, 0], *FORGETS[1:]], "pretrained policy on the retained skills"),
        ("sft", [*FORGETS[:2], [0, 0, 0, 0.5, 0]], "adaptation of sft"),
        ("sft", [*FORGETS[:2], [1, 0.5, 0, 1, 0]], "retention of sft"),
        ("joint", [*KEEPS[:2], [0.5, 0, 0.5, 0, 0]], "best final average (of frozen) minus that of joint"),
        ("frozen", [*STAYS[:2], [1, 1, 0, 0.7, 0]], "adaptation of frozen"),
    ],
)
def test_a_bar_that_is_missed_does_not_hold(method: str, success: Any, words: str, bench: Bench) -> None:
    bench.add_all()
    bench.add(method, success)
    found = bars(bench.card())
    assert {bar for bar, cells in found.items() if cells[-1] == "does not hold"} == {words}


def test_where_nothing_is_retained_fine_tuning_must_forget_the_earlier_targets(
    bench: Bench, tmp_path: Path
) -> None:
    bare = dataclasses.replace(TOY, retained=(), held_out=TOY.retained, scenes=TOY.retained)
    table = resolve("clbench.leaderboard.board.rows:Board")()
    experts = resolve("clbench.leaderboard.pages.scenario_tasks:Experts")(10, dict.fromkeys(NAMES, 9))
    card = resolve("clbench.leaderboard.pages.scenario_cards:Card")(bare, table, experts, frozenset()).page()
    assert list(bars(card))[:2] == ["adaptation of sft", "forgetting of earlier targets by sft"]
    assert "at least 0.40" in bars(card)["forgetting of earlier targets by sft"]
    assert "### Retained skills" in card
    assert "None." in part(card, "Tasks")


def test_missing_records_are_named_with_the_command_that_makes_them(bench: Bench) -> None:
    bench.add("sft", FORGETS)
    bench.add("frozen", STAYS)
    card = bench.card()
    command = f"clbench run clbench/Toy-v0 joint from_scratch --records {bench.records}"
    passage = f"Missing: records of joint, from_scratch. `{command}` makes them."
    assert passage in card
    assert bars(card)["best final average minus that of joint"] == ["at most 0.07", "-", "-"]


def test_stages_to_a_criterion_are_compared_with_replay_as_well() -> None:
    strict = dataclasses.replace(TOY, budget=dataclasses.replace(TOY.budget, criterion=0.9))
    table = resolve("clbench.leaderboard.board.rows:Board")()
    experts = resolve("clbench.leaderboard.pages.scenario_tasks:Experts")(10, dict.fromkeys(NAMES, 9))
    card = resolve("clbench.leaderboard.pages.scenario_cards:Card")(
        strict, table, experts, frozenset()
    ).page()
    assert "`clbench run clbench/Toy-v0 sft joint frozen from_scratch experience_replay` makes them." in card


def test_without_any_record_the_card_says_so_and_invents_nothing(bench: Bench) -> None:
    card = bench.card()
    command = f"clbench run clbench/Toy-v0 sft joint frozen from_scratch --records {bench.records}"
    assert f"`{command}` makes them." in card
    assert {tuple(cells[1:]) for cells in bars(card).values()} == {("-", "-")}
    assert part(card, "How small a difference it resolves").startswith(
        "Unknown: it needs records of at least two methods of one division"
    )
    assert part(card, "Order of the targets").startswith("The records have the published order only.")


def test_the_resolution_is_half_of_the_interval_of_a_difference_at_the_measured_spread(
    bench: Bench,
) -> None:
    for method, kept in (("sft", (1 / 6, 3 / 6, 2 / 6)), ("lwf", (3 / 6, 3 / 6, 4 / 6))):
        for seed, rate in enumerate(kept):
            bench.add(method, [*FORGETS[:2], [rate, rate, 0, 1, 0]], [seed])
    bench.add("joint", KEEPS)  # a reference does not compete,
    for seed in range(3):  # nor what learned by trial
        bench.add("ewc", [*FORGETS[:2], [0, seed / 2, 0, 1, 0]], [seed], online=True)
    table = part(bench.card(), "How small a difference it resolves")
    row = next(line for line in table.splitlines() if line.startswith("| retention |"))
    found = [float(cell) for cell in row.strip("| ").split(" | ")[1:]]
    deviation = np.std([2 / 6, 0, 2 / 6], ddof=1)
    half_widths = [stats.t.ppf(0.975, n - 1) * deviation / np.sqrt(n) for n in (4, 8)]
    assert found == pytest.approx([deviation, *half_widths], abs=6e-4)
    assert "- prior-data-free: 2 methods, " in table


def test_other_orders_are_shown_with_the_published_one(bench: Bench) -> None:
    bench.add("sft", FORGETS)
    bench.add("sft", KEEPS, [0, 1], order=1)
    passage = part(bench.card(), "Order of the targets")
    assert "| sft | 0: 0.25, 1: 1.00 | 0, 1 | - |" in passage  # two targets have two orders: no range


def test_where_nothing_draws_the_card_says_so_and_keeps_the_pictures_that_are_there(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.card()
    lost, kept = (bench.output / "Toy-v0" / f"{name}.webp" for name in ("left", "up"))
    before = kept.read_bytes()
    lost.unlink()
    monkeypatch.setattr("clbench.worlds.gl_backend.rendering_fault", lambda *_: "no display")
    card = bench.card()
    assert "Without a picture: left. No renderer drew them where this card was made." in card
    assert "| left | - | go left" in card
    assert "![up](Toy-v0/up.webp)" in card
    assert kept.read_bytes() == before
    assert "No pictures are drawn; existing ones are kept unless outdated." in " ".join(
        capsys.readouterr().err.split()
    )


def test_a_picture_of_a_former_version_does_not_pass_for_one_of_the_present(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.card()
    outdated, experts = (bench.output / "Toy-v0" / name for name in ("left.webp", "experts.json"))
    values = json.loads(experts.read_text(encoding="utf-8"))
    values["left"]["version"] = 7
    experts.write_text(json.dumps(values), encoding="utf-8")
    with monkeypatch.context() as without_renderer:
        without_renderer.setattr("clbench.worlds.gl_backend.rendering_fault", lambda *_: "no display")
        assert "Without a picture: left." in bench.card()
    assert not outdated.exists()
    assert "![left](Toy-v0/left.webp)" in bench.card()
    assert outdated.exists()


@pytest.mark.long
def test_a_card_that_is_made_again_has_the_same_bytes_and_nothing_is_measured_twice(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.add_all()
    bench.card()
    (bench.output / "Toy-v0" / "film.gif").write_bytes(b"a film")
    (bench.output / "Toy-v0" / "gone.webp").write_bytes(b"a task that the scenario no longer has")
    files = {path: path.read_bytes() for path in bench.output.rglob("*") if path.is_file()}
    del files[bench.output / "Toy-v0" / "gone.webp"]
    assert "5 experts measured, 5 pictures drawn" in capsys.readouterr().err
    bench.card()
    assert "0 experts measured, 0 pictures drawn" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in files} == files
    (bench.output / "Toy-v0" / "experts.json").write_text("[torn")
    (bench.output / "Toy-v0" / "up.webp").unlink()
    bench.card()
    assert "5 experts measured, 1 picture drawn" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in files} == files
    bench.card(episodes=4)
    assert "5 experts measured, 0 pictures drawn" in capsys.readouterr().err
    assert {*bench.output.glob("Toy-v0/*")} == {path for path in files if path.parent.name == "Toy-v0"}


@pytest.mark.long
def test_the_card_reports_records_of_another_version_of_the_scenario(bench: Bench) -> None:
    bench.add_all()
    assert "another version" not in bench.card()
    for path in bench.records.rglob("*.json"):
        values = json.loads(path.read_text(encoding="utf-8"))
        values["scenario"]["budget"]["batch_size"] = 8
        path.write_text(json.dumps(sealed(values)), encoding="utf-8")
    assert "The records belong to another version of this scenario: budget differ." in bench.card()


def test_words_of_strangers_are_no_markup(bench: Bench) -> None:
    bench.add("sft", FORGETS)
    for path in bench.records.rglob("*.json"):
        values = json.loads(path.read_text(encoding="utf-8"))
        values["fingerprint"]["versions"] = {"<b>x": "1 | 2\n## y", "z": ["<b>"]}
        path.write_text(json.dumps(sealed(values)), encoding="utf-8")
    bench.card()
    text = (bench.output / "Toy-v0.md").read_text(encoding="utf-8")
    assert "<b>" not in text.replace("\\<", "")
    assert "## y" not in re.findall("^## .*", text, re.MULTILINE)


def test_without_a_name_cards_that_are_there_are_made_again_without_pictures_of_former_tasks(
    bench: Bench,
) -> None:
    new, picture = bench.card(), bench.output / "Toy-v0" / "former.webp"
    picture.write_bytes((bench.output / "Toy-v0" / "up.webp").read_bytes())
    (bench.output / "Toy-v0.md").write_text("old")
    scenario_card(records=bench.records, output=bench.output, episodes=3)
    assert (bench.output / "Toy-v0.md").read_text().replace("\\", "") == new
    assert not picture.exists()


def test_without_a_name_the_scenarios_with_records_have_cards(bench: Bench) -> None:
    with pytest.raises(SystemExit) as stopped:
        scenario_card(records=bench.records, output=bench.output)
    assert stopped.value.code == 2
    bench.add("sft", FORGETS)
    scenario_card(records=bench.records, output=bench.output, episodes=1)
    assert sorted(path.name for path in bench.output.iterdir()) == ["Toy-v0", "Toy-v0.md"]


@pytest.mark.parametrize(
    ("scenario", "options", "reason"),
    [
        ("clbench/Toi-v0", {}, "Did you mean 'clbench/Toy-v0'?"),
    ],
)
def test_a_wrong_word_is_named(
    scenario: str, options: dict[str, Any], reason: str, bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        bench.card(scenario, **options)
    assert stopped.value.code == 2
    assert reason in " ".join(capsys.readouterr().err.split())
    assert not bench.output.exists()


def test_one_seed_has_intervals_over_episodes_and_none_of_its_checks(
    make_record: Callable[..., Record], tmp_path: Path
) -> None:
    budget = dataclasses.replace(TOY.budget, adaptation_steps=20, criterion=0.9)
    scenario = dataclasses.replace(TOY, id="clbench/Even-v1", budget=budget)
    success = [[1, 1, 0.1, 0, 0], [0.5, 0.5, 0.9, 0.3, 0], [0.5, 0.5, 0.5, 0.9, 0]]
    record = make_record(success, steps=(20,), ends=(8, 20), method="sft", scenario=scenario.id)
    write_record(record, tmp_path / "Even-v1" / "sft" / "seed-0.json")
    board = resolve("clbench.leaderboard.board.rows:compute_board")(tmp_path)
    experts = resolve("clbench.leaderboard.pages.scenario_tasks:Experts")(3, dict.fromkeys(NAMES, 3))
    card = resolve("clbench.leaderboard.pages.scenario_cards:Card")(scenario, board, experts, frozenset())
    page = card.page().replace("\\", "")
    assert "95 % confidence intervals over seeds (over episodes if there is only one seed)." in page
    assert bars(page)["checks of sft until a target is learned"][1] == "8.00"


@pytest.mark.long
def test_a_scenario_with_a_criterion_has_bars_and_orders_of_its_own(
    make_record: Callable[..., Record], tmp_path: Path
) -> None:
    budget = dataclasses.replace(TOY.budget, adaptation_steps=20, criterion=0.9)
    skill = dataclasses.replace(TOY.retained[0], test_instructions=("a wording of the test",))
    scenario = dataclasses.replace(
        TOY,
        id="clbench/Even-v1",
        retained=(skill, *TOY.retained[1:]),
        budget=budget,
        background=(dataclasses.replace(skill, name="practised"),),
        balanced=True,
    )
    for method, kept in (("sft", 0.5), ("experience_replay", 1.0), ("frozen", 0.2)):
        for seed in range(3):
            success = [[1, 1, 0.1, 0, 0], [kept, kept, 0.9, 0.3, 0], [kept, kept, kept, 0.9, 0]]
            options = {"method": method, "seed": seed, "scenario": scenario.id}
            record = make_record(success, steps=(20,), ends=(8, 20), **options)
            write_record(record, tmp_path / "Even-v1" / method / f"seed-{seed}.json")
    board = resolve("clbench.leaderboard.board.rows:compute_board")(tmp_path)
    experts = resolve("clbench.leaderboard.pages.scenario_tasks:Experts")(3, dict.fromkeys(NAMES, 3))
    card = resolve("clbench.leaderboard.pages.scenario_cards:Card")(scenario, board, experts, frozenset())
    found = bars(card.page().replace("\\", ""))
    assert {words: (cells[0], cells[1].split()[0], cells[2]) for words, cells in found.items()} == {
        "final average of sft": ("at most 0.85", "0.60", "holds"),  # the row before: at least 0.30
        "final average of experience_replay": ("at least 0.90", "0.97", "holds"),
        "final average of experience_replay minus that of sft": ("at least 0.10", "0.38", "holds"),
        "final average of sft minus that of frozen": ("at least 0.00", "0.23", "holds"),
        "success of sft on a target before its stage": ("at most 0.30", "0.20", "holds"),
        "checks of sft until a target is learned": ("at least 8.00", "8.00", "holds"),
    }
    assert "Latin square" in part(card.page(), "Order of the targets")
    assert "<br>in test episodes:<br>a wording of the test |" in part(card.page(), "Tasks")
    assert (
        "The policy is also pretrained on these tasks, which count in no score and which no method trains on "
        "again: practised." in part(card.page(), "Tasks")
    )
    assert "The policy is evaluated at the end of each stage." in part(card.page(), "Budget")
