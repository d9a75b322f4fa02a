"""Films: show the same episode side by side with the policies of several stages or methods.

A film shows validation episodes, never test episodes. The policies act as in evaluation: the drawn world
repeats the actions of an `Evaluator`, so a film ends like the recorded episode.
"""

from __future__ import annotations

import functools
import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from clbench.base.dependencies import require
from clbench.base.errors import InputError
from clbench.base.leftovers import replacing
from clbench.base.progress import ProgressCallback, no_progress
from clbench.evaluation.episodes import Episode, Trial, start_of
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.optimise import deterministic
from clbench.policy.policy import Policy
from clbench.runs.spec import ResolvedRun
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.lanes import control_rate
from clbench.worlds.world import World, opened_worlds

FORMATS = (".gif", ".mp4")

FASTEST = 50
"""Most frames per second: a GIF counts in hundredths of a second, and browsers slow down faster films."""

FILMS = Path("films")
"""Folder of films, relative to the working directory."""

HOLD_SECONDS = 2.0
"""Time for which a film holds its last frame, in seconds."""

PAPER, INK, FAINT = "#ffffff", "#1a1a1a", "#5c5c5c"
SUCCESS, FAILURE = "#00694d", "#b34700"
"""Bluish green and vermilion: colour-blind readers can distinguish them, and white letters are legible."""

GAP, BORDER, LINE = 8, 4, 18
"""Gap between panels, border of a picture whose episode has ended, and height of a line, in pixels."""


@dataclass(frozen=True)
class Take:
    """One episode on film."""

    pictures: list[Image.Image]
    """Pictures of the initial state and of the state after each step."""
    episode: Episode
    """Outcome of the episode."""


def check_format(path: Path) -> None:
    """Check that a film can be written to `path`.

    Raises:
        MissingPackageError: MP4 needs a package that is not installed.
        InputError: The name of the file ends neither in .gif nor in .mp4.
    """
    if path.suffix not in FORMATS:
        raise InputError(f"A film is a {' or '.join(FORMATS)} file, not {path.name!r}.")
    if path.suffix == ".mp4":
        require("imageio_ffmpeg", "film", "An MP4")


def shoot(
    scenario: Scenario,
    seed: int,
    policies: Sequence[Policy],
    trials: Sequence[Trial],
    width: int,
    progress: ProgressCallback = no_progress,
) -> list[list[Take]]:
    """Return the takes: for each trial, one take per policy.

    Args:
        scenario: Scenario of the tasks.
        seed: Seed of the run: it chooses the initial states.
        policies: Policies that act.
        trials: Episodes by task, split and number.
        width: Width of a picture, in pixels.
        progress: Called with the number of takes made since its last call.

    Raises:
        RuntimeError: A world does not repeat an episode.
    """
    takes: list[list[Take]] = [[] for _ in trials]
    with closing(Evaluator(scenario, seed)) as evaluator, opened_worlds(render_mode="rgb_array") as world:
        for policy in policies:
            with deterministic(str(policy.device)):
                episodes, actions = _act(evaluator, policy, trials)
            for column, trial, episode in zip(takes, trials, episodes, strict=True):
                task = trial.task
                pictures, success = _repeat(world(task), trial, seed, actions[trial], width)
                if success != episode.success:
                    raise RuntimeError(f"{task.world} does not repeat an episode of {task.name!r}.")
                column.append(Take(pictures, episode))
                progress(1)
    return takes


def _act(
    evaluator: Evaluator, policy: Policy, trials: Sequence[Trial]
) -> tuple[list[Episode], dict[Trial, list[NDArray[np.float32]]]]:
    """Return the outcomes of the trials, and the actions (A,) taken in each."""
    actions: dict[Trial, list[NDArray[np.float32]]] = defaultdict(list)
    episodes = evaluator.play(policy, trials, watch=lambda trial, act: actions[trial].append(act))
    return episodes, actions


def _repeat(
    world: World, trial: Trial, seed: int, actions: Sequence[NDArray[np.float32]], width: int
) -> tuple[list[Image.Image], bool]:
    """Return the pictures of an episode with the given actions, and whether it is a success."""
    task = trial.task
    world.reset(seed=start_of(trial, seed)[0], options={"task": task.name})
    pictures, success = [picture(world, width)], False
    for action in actions:
        _, _, success, _, _ = world.step(action)
        pictures.append(picture(world, width))
    return pictures, success


def picture(world: World, width: int) -> Image.Image:
    """Return a picture of a world, `width` pixels wide. Enlarged pictures keep their hard edges."""
    picture = Image.fromarray(np.asarray(world.render()))
    size = (width, round(picture.height * width / picture.width))
    larger = width > picture.width
    return picture.resize(size, Image.Resampling.NEAREST if larger else Image.Resampling.LANCZOS)


@dataclass(frozen=True)
class Film:
    """Takes side by side: a row for each episode, a column for each policy.

    All takes begin together. A take that has ended holds its last picture, with a frame and a word that show
    the outcome.
    """

    title: str
    """Title of the film."""
    rows: Sequence[str]
    """Caption of each episode."""
    columns: Sequence[str]
    """Name of each policy."""
    takes: Sequence[Sequence[Take]]
    """Takes of each row, one for each column."""

    def __len__(self) -> int:
        """Return the number of different frames."""
        return max(len(take.pictures) for row in self.takes for take in row)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels; MP4 requires even numbers."""
        across, down = self._corner(len(self.rows), len(self.columns))
        down -= LINE
        return across + across % 2, down + down % 2

    def _corner(self, row: int, column: int) -> tuple[int, int]:
        """Return the top left corner of a panel: a line for the policy, a picture, a line for the outcome."""
        sizes = [take.pictures[0].size for takes in self.takes for take in takes]
        width, height = (max(side) for side in zip(*sizes, strict=True))
        return GAP + column * (width + GAP), 2 * GAP + 2 * LINE + row * (3 * LINE + height + GAP)

    @functools.cached_property
    def _sheet(self) -> Image.Image:
        """Everything that is the same in all frames."""
        sheet = Image.new("RGB", self.size, PAPER)
        draw = ImageDraw.Draw(sheet)
        panel = self.takes[0][0].pictures[0].width
        _write(draw, (GAP, GAP), self.title, self.size[0] - 2 * GAP, INK)
        for row, caption in enumerate(self.rows):
            left, top = self._corner(row, 0)
            _write(draw, (left, top - LINE), caption, self.size[0] - 2 * GAP, INK)
            for column, name in enumerate(self.columns):
                _write(draw, self._corner(row, column), name, panel, FAINT)
        return sheet

    def frame(self, time: int) -> Image.Image:
        """Return the frame after `time` steps."""
        frame = self._sheet.copy()
        draw = ImageDraw.Draw(frame)
        for row, takes in enumerate(self.takes):
            for column, take in enumerate(takes):
                left, top = self._corner(row, column)
                picture = take.pictures[min(time, take.episode.length)]
                top += LINE
                frame.paste(picture, (left, top))
                below = top + picture.height
                if time < take.episode.length:
                    _write(draw, (left, below), f"step {time}", picture.width, FAINT)
                    continue
                word, colour = ("success", SUCCESS) if take.episode.success else ("failure", FAILURE)
                right = left + picture.width - 1
                draw.rectangle((left, top, right, below - 1), outline=colour, width=BORDER)
                draw.rectangle((left, below, right, below + LINE - 1), fill=colour)
                words = f"{word}, {take.episode.length} steps"
                _write(draw, (left + BORDER, below), words, picture.width - BORDER, PAPER)
        return frame

    def save(self, path: Path, fps: int) -> None:
        """Write the film, in one step, as GIF or MP4 depending on the name of the file.

        Args:
            path: Path of the film, which `check_format` has accepted.
            fps: Number of steps shown per second.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            (self._save_gif if path.suffix == ".gif" else self._save_mp4)(partial, fps)

    def _save_gif(self, path: Path, fps: int) -> None:
        palette = self._palette()
        frames = (
            self.frame(time).quantize(palette=palette, dither=Image.Dither.NONE) for time in range(len(self))
        )
        starts = [round(100 * time / fps) for time in range(len(self))]  # in hundredths of a second
        milliseconds = [10 * (end - start) for start, end in itertools.pairwise(starts)]
        milliseconds.append(round(1000 * HOLD_SECONDS))
        next(frames).save(path, "GIF", save_all=True, append_images=frames, duration=milliseconds, loop=0)

    def _palette(self) -> Image.Image:
        """Return 256 colours for all frames, so that unchanged parts do not flicker."""
        samples = [self.frame(time) for time in (0, len(self) // 2, len(self) - 1)]
        width, height = self.size
        stack = Image.new("RGB", (width, 3 * height), PAPER)
        for number, sample in enumerate(samples):
            stack.paste(sample, (0, number * height))
        ours = np.array([ImageColor.getrgb(colour) for colour in (PAPER, INK, FAINT, SUCCESS, FAILURE)])
        found = np.reshape(stack.quantize(256 - len(ours)).getpalette() or [], (-1, 3))
        # Pillow searches for the nearest colour in steps of 4 and would confuse a close colour with ours
        far = np.abs(found[:, None] - ours).max(axis=2).min(axis=1) > 8
        palette = Image.new("P", (1, 1))
        palette.putpalette([int(channel) for channel in np.concatenate([ours, found[far]]).ravel()])
        return palette

    def _save_mp4(self, path: Path, fps: int) -> None:
        from imageio_ffmpeg import write_frames

        # one thread and no encoder name in the file: the same film has the same bytes
        exact = ["-threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact", "-crf", "23", "-f", "mp4"]
        frames = write_frames(path, self.size, fps=fps, macro_block_size=2, output_params=exact)
        with closing(frames) as writer:
            writer.send(None)
            for time in range(len(self) + round(HOLD_SECONDS * fps)):
                writer.send(self.frame(min(time, len(self) - 1)).tobytes())


def _write(draw: ImageDraw.ImageDraw, place: tuple[int, int], text: str, width: int, colour: str) -> None:
    """Write a line of text that begins at `place`, cut to `width` pixels."""
    font = _font()
    if draw.textlength(text, font) > width:
        while text and draw.textlength(f"{text}...", font) > width:
            text = text[:-1]
        text = f"{text.rstrip()}..."
    draw.text((place[0], place[1] + LINE // 2), text, fill=colour, font=font, anchor="lm")


def film_runs(
    runs: Sequence[ResolvedRun],
    policies: Mapping[str, Policy],
    tasks: Sequence[Task],
    number: int,
    width: int,
    progress: ProgressCallback = no_progress,
) -> Film:
    """Return the film of one run, or of several runs that differ in their method alone.

    Args:
        runs: The runs.
        policies: Policies by the captions of their columns.
        tasks: Tasks of the rows.
        number: Number of the validation episode.
        width: Width of a picture, in pixels.
        progress: Called with the number of takes made since its last call.
    """
    first, scenario, seed = runs[0], runs[0].scenario, runs[0].spec.seed
    trials = [Trial(task, "validation", number) for task in tasks]
    rows = [
        f"{task.name} ({scenario.group(task.name).replace('_', ' ')}): {start_of(trial, seed)[1]}"
        for task, trial in zip(tasks, trials, strict=True)
    ]
    labels = ", ".join(run.label for run in runs)
    order = f" order {first.spec.order}" if first.spec.order else ""
    title = f"{first.table}, {labels}, seed {seed}{order}, validation episode {number}"
    takes = shoot(scenario, seed, list(policies.values()), trials, width, progress)
    return Film(title, rows, list(policies), takes)


def column_of(run: ResolvedRun, stage: int, *, alone: bool) -> str:
    """Return the caption of a stage's column; beside other methods, it also names the method."""
    when = f"after {run.scenario.target[stage - 1].name}" if stage else "before any target"
    if alone:
        return f"stage {stage}, {when}"
    if stage == len(run.scenario.target):
        return f"after {run.label}"
    return f"{run.label}, {when}" if stage else when


def frames_per_second(task: Task) -> int:
    """Return the frame rate of a task's films: that of its world (25 if it has none), at most `FASTEST`."""
    return min(int(control_rate(task) or 25), FASTEST)


@functools.cache
def _font() -> Any:
    """Return the font that comes with Pillow, so that films look the same on all machines."""
    return ImageFont.load_default(LINE - 5)
