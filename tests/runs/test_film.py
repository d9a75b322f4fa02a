"""Films: they end like the recorded episodes, and show the outcome in colour and in words."""

import dataclasses
import os
import subprocess
import sys
import types
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from helpers import back_end_or_skip, stage_policies
from PIL import Image, ImageDraw

from clbench.cli.film import film
from clbench.evaluation.episodes import Episode, Trial
from clbench.policy.policy import Policy
from clbench.records.record import Record
from clbench.runs.film import (
    FAILURE,
    FASTEST,
    SUCCESS,
    Film,
    Take,
    check_format,
    column_of,
    film_runs,
    frames_per_second,
    shoot,
)
from clbench.runs.run import execute
from clbench.runs.spec import ResolvedRun, RunSpec
from clbench.runs.stages import find_stages, load_stages
from clbench.spec.registry import load_scenario
from clbench.testing import ToyWorld

TOY = "clbench.testing:clbench/Toy-v0"
SPEC = RunSpec(TOY, "sft", seed=0, split="validation")
SCENARIO = load_scenario(TOY)
COLUMNS = ("stage", "step", "task", "split", "episode", "success", "length")


@pytest.fixture(autouse=True)
def _own_process_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore what a command sets in its process."""
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", ""))
    monkeypatch.setattr(sys, "path", sys.path.copy())


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Record, Path]:
    """A run evaluated on validation episodes: its record, and the folder of its kept policies."""
    folder = tmp_path_factory.mktemp("recorded")
    return execute(SPEC, folder / "records", checkpoints=folder), folder


@pytest.fixture
def drawn() -> Film:
    """A film without a policy: a success after two steps next to a failure after four."""
    pictures = [Image.fromarray(np.full((100, 140, 3), shade, np.uint8)) for shade in (40, 80, 120, 160, 200)]
    good = Take(pictures[:3], Episode("reach", "validation", 0, True, 1.0, 2))
    bad = Take(pictures, Episode("reach", "validation", 0, False, -1.0, 4))
    return Film(
        "a film", ["reach: go there"], ["stage 0, before any target", "stage 1, after push"], [[good, bad]]
    )


def _colours(frame: Image.Image) -> set[str]:
    """Return the colours that fill at least a line of a frame."""
    counts = frame.getcolors(frame.width * frame.height)
    assert counts is not None
    return {"#{:02x}{:02x}{:02x}".format(*colour) for count, colour in counts if count > 100}  # type: ignore[misc]


def test_an_episode_that_has_ended_holds_its_picture_in_the_colour_of_its_outcome(drawn: Film) -> None:
    assert len(drawn) == 5
    seen = [_colours(drawn.frame(time)) for time in range(5)]
    assert [SUCCESS in colours for colours in seen] == [False, False, True, True, True]
    assert [FAILURE in colours for colours in seen] == [False, False, False, False, True]
    shades = [{f"#{shade:02x}{shade:02x}{shade:02x}" for shade in (120, shade)} for shade in (120, 160, 200)]
    assert all(shown <= colours for shown, colours in zip(shades, seen[2:], strict=True))


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Lines of text that are drawn."""
    lines: list[str] = []
    draw = ImageDraw.ImageDraw.text

    def note(self: ImageDraw.ImageDraw, place: Any, text: Any, *rest: Any, **options: Any) -> None:
        lines.append(text)
        draw(self, place, text, *rest, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", note)
    return lines


def test_a_film_has_captions_and_outcomes_in_words(drawn: Film, written: list[str]) -> None:
    drawn.frame(1)
    assert written[:2] == ["a film", "reach: go there"]
    assert written[-2:] == ["step 1", "step 1"]
    drawn.frame(2)
    assert written[-2:] == ["success, 2 steps", "step 2"]
    drawn.frame(4)
    assert written[-2:] == ["success, 2 steps", "failure, 4 steps"]


def test_a_text_that_does_not_fit_is_cut_off(drawn: Film, written: list[str]) -> None:
    Film("word " * 100, drawn.rows, drawn.columns, drawn.takes).frame(0)
    assert written[0].startswith("word word")
    assert written[0].endswith("...")
    assert len(written[0]) < 60


def test_a_gif_has_every_step_and_holds_its_last_frame(drawn: Film, tmp_path: Path) -> None:
    for name in ("one.gif", "two.gif"):
        drawn.save(tmp_path / "films" / name, 20)
    one, two = ((tmp_path / "films" / name).read_bytes() for name in ("one.gif", "two.gif"))
    assert one == two
    assert len(list((tmp_path / "films").iterdir())) == 2
    with Image.open(tmp_path / "films" / "one.gif") as gif:
        assert (gif.size, gif.n_frames, gif.info["loop"]) == (drawn.size, 5, 0)
        durations = []
        for number in range(5):
            gif.seek(number)
            durations.append(gif.info["duration"])
        assert {SUCCESS, FAILURE} <= _colours(gif.convert("RGB"))
    assert durations == [50, 50, 50, 50, 2000]


def test_a_gif_has_the_speed_that_was_asked_for(drawn: Film, tmp_path: Path) -> None:
    drawn.save(tmp_path / "film.gif", 40)
    with Image.open(tmp_path / "film.gif") as gif:
        durations = []
        for number in range(5):
            gif.seek(number)
            durations.append(gif.info["duration"])
    assert durations == [
        20,
        30,
        30,
        20,
        2000,
    ]  # a GIF counts in hundredths of a second; four steps take 0.1 s


@pytest.mark.long
@pytest.mark.skipif(find_spec("imageio_ffmpeg") is None, reason="the extra film is not installed")
def test_an_mp4_has_every_step_and_holds_its_last_frame(drawn: Film, tmp_path: Path) -> None:
    from imageio_ffmpeg import count_frames_and_secs, read_frames

    for name in ("one.mp4", "two.mp4"):
        drawn.save(tmp_path / name, 20)
    assert (tmp_path / "one.mp4").read_bytes() == (tmp_path / "two.mp4").read_bytes()
    assert count_frames_and_secs(tmp_path / "one.mp4")[0] == 5 + 2 * 20
    frames = read_frames(tmp_path / "one.mp4")
    assert next(frames)["size"] == drawn.size
    first = np.frombuffer(next(frames), np.uint8).reshape(*reversed(drawn.size), 3)
    assert np.abs(first.astype(np.int16) - np.asarray(drawn.frame(0), np.int16)).mean() < 4
    frames.close()


@pytest.mark.long
def test_a_film_ends_like_the_recorded_episodes(recorded: tuple[Record, Path]) -> None:
    record, folder = recorded
    policies = stage_policies(SPEC.resolve(), folder)
    tasks = [*SCENARIO.retained, *SCENARIO.target]
    ends = {0: 0, 1: 60, 2: 60}
    rows = set(zip(*(record.episodes[name] for name in COLUMNS), strict=True))
    outcomes = set()
    run = SPEC.resolve()
    columns = {column_of(run, stage, alone=True): policy for stage, policy in enumerate(policies)}
    for number in (0, 3):
        made = film_runs([run], columns, tasks, number, 96)
        for task, takes in zip(tasks, made.takes, strict=True):
            for stage, take in enumerate(takes):
                episode = take.episode
                outcomes.add(episode.success)
                row = (
                    stage,
                    ends[stage],
                    task.name,
                    "validation",
                    number,
                    int(episode.success),
                    episode.length,
                )
                assert row in rows
                assert len(take.pictures) == episode.length + 1
    assert outcomes == {True, False}
    assert made.columns == ["stage 0, before any target", "stage 1, after right", "stage 2, after down"]
    assert made.rows[1:3] == ["up (retained): move up", "right (target): move to the right"]


def test_all_columns_of_a_row_begin_with_the_same_picture(recorded: tuple[Record, Path]) -> None:
    policies = stage_policies(SPEC.resolve(), recorded[1])
    trials = [Trial(SCENARIO.task(name), "validation", 1) for name in ("left", "down")]
    takes = shoot(SCENARIO, 0, policies, trials, 32)
    starts = [[np.asarray(take.pictures[0]) for take in row] for row in takes]
    assert all(np.array_equal(row[0], other) for row in starts for other in row)
    assert not np.array_equal(starts[0][0], starts[1][0])


class Unsteady(ToyWorld):
    """A world that behaves differently when it is drawn; the class counts its open worlds."""

    still_open: ClassVar[int] = 0

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        Unsteady.still_open += 1

    def close(self) -> None:
        Unsteady.still_open -= 1

    def step(self, action: Any) -> Any:
        return super().step(action if self.render_mode is None else 0 * action)


def test_a_world_that_does_not_repeat_an_episode_is_refused_and_all_worlds_are_closed(
    recorded: tuple[Record, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = types.ModuleType("stranger")
    module.__dict__["Unsteady"] = Unsteady
    monkeypatch.setitem(sys.modules, "stranger", module)
    task = dataclasses.replace(SCENARIO.task("left"), world="stranger:Unsteady")
    policies = stage_policies(SPEC.resolve(), recorded[1])[:1]
    with pytest.raises(RuntimeError, match="stranger:Unsteady does not repeat an episode of 'left'"):
        shoot(SCENARIO, 0, policies, [Trial(task, "validation", 0)], 32)
    assert Unsteady.still_open == 0


def test_the_command_writes_the_requested_film(recorded: tuple[Record, Path], tmp_path: Path) -> None:
    path = tmp_path / "toy.gif"
    film(
        TOY, "sft", tasks="left,down", stages="0,2", episode=1, size=96, output=path, checkpoints=recorded[1]
    )
    with Image.open(path) as gif:
        assert gif.size == (2 * (96 + 8) + 8, 18 + 16 + 2 * (96 + 3 * 18 + 8))
        assert gif.info["duration"] == 100  # ten steps in a second, as the world says


def test_a_film_does_not_take_the_place_of_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "toy.gif"
    folder.mkdir()
    with pytest.raises(SystemExit, match="2"):
        film(TOY, "sft", output=folder)
    assert f"--output {folder} is a folder: name a file." in capsys.readouterr().err


@pytest.mark.slow  # 5 s
def test_a_film_of_several_methods_shows_each_after_the_last_target(
    recorded: tuple[Record, Path], tmp_path: Path, written: list[str]
) -> None:
    path = tmp_path / "toy.gif"
    film(TOY, "sft", "frozen", tasks="left", size=120, output=path, checkpoints=recorded[1])
    assert written[0].startswith("clbench/Toy-v0, sft, frozen, seed 0, val")
    assert written[2:5] == ["before any target", "after sft", "after frozen"]
    with Image.open(path) as gif:
        assert gif.size[0] == 3 * (120 + 8) + 8


def test_a_method_that_changes_the_policy_before_the_first_target_has_a_column_of_its_own(
    recorded: tuple[Record, Path], tmp_path: Path, written: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = find_stages(SPEC.resolve(), recorded[1])

    def load(run: ResolvedRun, folder: Path) -> list[Policy]:
        policies = load_stages(SPEC.resolve(), folder)
        if run.label == "fast_dvla":
            torch.nn.init.zeros_(next(policies[0].parameters()))
        if run.label == "l2_sp":
            policies[0].register_buffer("added", torch.zeros(1))
        return policies

    monkeypatch.setattr("clbench.runs.stages.find_stages", lambda *_: kept)
    monkeypatch.setattr("clbench.runs.stages.load_stages", load)
    film(TOY, "sft", "l2_sp", "fast_dvla", tasks="left", size=240, output=tmp_path / "toy.gif")
    shared, own = "sft and l2_sp, before any target", "fast_dvla, before any target"
    assert written[2:7] == [shared, "after sft", "after l2_sp", own, "after fast_dvla"]


@pytest.mark.long
def test_policies_of_another_kind_and_order_are_filmed_as_they_were_kept(
    tmp_path: Path, written: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = RunSpec(TOY, "frozen", 0, order=1, policy="discrete_diffusion")
    execute(spec, tmp_path / "records", checkpoints=tmp_path)
    monkeypatch.setattr("clbench.jobs.scheduler.run_with_bars", lambda *_: pytest.fail("trained again"))
    chosen: dict[str, Any] = {"order": 1, "policy": "discrete_diffusion"}
    film(TOY, "frozen", tasks="left", size=260, output=tmp_path / "toy.gif", checkpoints=tmp_path, **chosen)
    assert written[0].startswith("clbench/Toy-v0+discrete_diffusion, frozen, seed 0 order 1, val")
    assert written[2:5] == ["stage 0, before any target", "stage 1, after down", "stage 2, after right"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tasks": "left,doun"}, "No task of clbench/Toy-v0 is called 'doun'. Did you mean 'down'?"),
        ({"tasks": ""}, "--tasks has an empty item: ''."),
        ({"stages": "0,3"}, "--stages takes numbers from 0 to 2, not 0,3."),
        ({"stages": "last"}, "--stages takes numbers from 0 to 2, not last."),
        ({"episode": 4}, "--episode must be from 0 to 3, not 4."),
        ({"fps": 60}, "--fps must be from 1 to 50, not 60."),
        ({"output": Path("toy.avi")}, "A film is a .gif or .mp4 file, not 'toy.avi'."),
        ({"changes": {"rate": "1"}}, "sft has no hyper-parameter 'rate'"),
        ({"output": Path(__file__, "toy.gif")}, f"{Path(__file__)} cannot be written to: Not a directory."),
    ],
)
def test_bad_input_ends_with_exit_code_2_before_any_work(
    options: dict[str, Any], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        film(TOY, "sft", **options)
    assert left.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.long
def test_films_of_other_tasks_stages_or_episodes_have_other_names(
    recorded: tuple[Record, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    chosen: list[dict[str, Any]] = [
        {"tasks": "left, up", "stages": "0"},
        {"tasks": "left", "stages": "0", "episode": 1},
        {"tasks": "left", "stages": "0,1,2", "episode": 3},
    ]
    for options in chosen:
        film(TOY, "sft", checkpoints=recorded[1], **options)
    assert {path.name for path in tmp_path.rglob("*.gif")} == {
        "seed-0+tasks=left,up+stages=0.gif",
        "seed-0+tasks=left+stages=0+episode=1.gif",
        "seed-0+tasks=left+stages=0,1,2+episode=3.gif",
    }


def test_a_film_needs_a_method(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        film(TOY)
    assert left.value.code == 2
    assert "Name at least one method, for example sft." in capsys.readouterr().err


def test_an_mp4_without_its_package_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clbench.base.dependencies.find_spec", lambda name: None)
    with pytest.raises(LookupError, match=r"needs the package imageio_ffmpeg: pip install 'clbench\[film\]'"):
        check_format(Path("film.mp4"))


FETCH = """
import sys
from pathlib import Path
from clbench.evaluation.episodes import Trial
from clbench.runs.film import shoot
from clbench.policy.transformer import TransformerPolicy
from clbench.learning.pretraining import policy_config
from clbench.spec.registry import load_scenario

scenario = load_scenario("clbench/Fetch-v1")
policy = TransformerPolicy(policy_config(scenario), seed=3)
((take,),) = shoot(scenario, 0, [policy], [Trial(scenario.task("push"), "validation", 0)], 96)
print(take.episode.length, len({picture.tobytes() for picture in take.pictures}), *take.pictures[0].size)
"""


@pytest.mark.slow
def test_the_fetch_world_is_drawn_on_machines_that_can_draw() -> None:
    environment = {**os.environ, "MUJOCO_GL": back_end_or_skip()}
    command = [sys.executable, "-c", FETCH]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    length, different, width, height = map(int, result.stdout.split())
    assert length == load_scenario("clbench/Fetch-v1").task("push").horizon  # the policy was never trained
    assert different == length + 1  # and it moves the arm all the time
    assert (width, height) == (96, 96)


def test_a_film_shows_at_most_as_many_steps_per_second_as_a_gif_can() -> None:
    assert frames_per_second(load_scenario("clbench/Fetch-v1").target[0]) == 25
    assert frames_per_second(load_scenario("clbench/MetaWorld-v1").target[0]) == FASTEST == 50
