"""Questions about a scene with one right answer, made from the state of the simulator.

They represent the knowledge of a vision-language model, which a policy has before it is fine-tuned.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor

from clbench.base.cache import cache_folder, cached, hash_of
from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import SPLIT_LABELS, derive_seed, torch_generator
from clbench.base.source import DATA_SOURCES, source_hash
from clbench.base.text import quoted
from clbench.data.access import check_questions
from clbench.data.demonstrations import demonstrate, simulator_versions
from clbench.policy.batch import QuestionBatch
from clbench.spec.fields import check_tuple
from clbench.spec.language import TEXT_LENGTH, encode, word_id
from clbench.spec.scenario import Scenario
from clbench.spec.task import packages_of
from clbench.worlds.camera import Images
from clbench.worlds.observation import observed
from clbench.worlds.world import States, opened_worlds

Truths: TypeAlias = NDArray[np.bool_]
"""Whether something holds in each of the states (N,)."""
Answers: TypeAlias = NDArray[np.int64]
"""Index of the right answer in each of the states (N,), -1 in close cases."""


def which(*truths: Truths) -> Answers:
    """Return the index of the first of the truths that holds, -1 where none does."""
    return np.select(truths, range(len(truths)), default=-1).astype(np.int64)


def sign(difference: NDArray[np.float32], margin: float) -> Answers:
    """Return 0 where the difference (N,) is above `margin`, 1 where it is below -`margin`, else -1."""
    return which(difference > margin, difference < -margin)


@dataclass(frozen=True)
class QuestionKind:
    """A question about a state, in several wordings."""

    name: str
    """Name of the kind, such as "block_left_of_gripper"."""
    wordings: tuple[str, ...]
    """Wordings of the question, all with the same meaning."""
    answers: tuple[str, ...]
    """Possible answers, each a word of the vocabulary."""
    answer: Callable[[NDArray[np.float32]], Answers]
    """Function that maps states (N, S) to the indices of their answers (N,)."""

    def __post_init__(self) -> None:
        check_tuple(self, str, "wordings", "answers")
        if not self.wordings or not self.answers:
            raise InputError(f"The kind of question {quoted(self.name)} needs a wording and an answer.")


def scenes_folder(scenario: Scenario, progress: ProgressCallback = no_progress) -> Path:
    """Return the folder of the states for the questions, which are collected on first use.

    The states come from noisy expert episodes of the scenario's `scene_tasks`, and are split by episode
    into `train` and `test`.

    Args:
        scenario: Scenario of the questions.
        progress: Called with the number of episodes collected since its last call.
    """
    tasks = scenario.scene_tasks
    inputs = {
        "scenario": scenario.id,
        "tasks": [dataclasses.asdict(task) for task in tasks],
        "episodes": scenario.budget.question_episodes,
        "source": source_hash(*DATA_SOURCES, *packages_of(tasks, "world", "expert")),
        "versions": simulator_versions(tasks),
    }
    folder = cache_folder() / "scenes" / hash_of(inputs)

    def make(partial: Path) -> None:
        save_file(_scenes(scenario, progress), partial / "scenes.safetensors")

    return cached(folder, inputs, make)


def _scenes(scenario: Scenario, progress: ProgressCallback) -> dict[str, Tensor]:
    scenes = {}
    count = scenario.budget.question_episodes
    with opened_worlds() as world:
        for split, episodes in (("train", count), ("test", max(1, count // 4))):
            states = []
            for number in range(episodes):
                task = scenario.scene_tasks[number % len(scenario.scene_tasks)]
                seed = derive_seed("scene", scenario.id, SPLIT_LABELS[split], number)
                states.append(demonstrate(world(task), task, seed, noisy=True).state)
                progress(1)
            scenes[split] = torch.from_numpy(np.concatenate(states))
    return scenes


class Questions:
    """Questions about a set of states: all kinds are equally frequent, and so are all answers within a kind.

    Args:
        kinds: Kinds of questions to ask.
        scenes: States (N, S) to ask about.
        shown: Numbers (N, P) and pictures that a policy sees of the states; None shows the states.
        text_length: Length of the questions in tokens.

    Raises:
        InputError: A kind has an answer that no state gives.
    """

    def __init__(
        self,
        kinds: tuple[QuestionKind, ...],
        scenes: Tensor,
        shown: tuple[States, Images] | None = None,
        text_length: int = TEXT_LENGTH,
    ) -> None:
        self.kinds = kinds
        self.scenes = scenes
        self.state, self.image = scenes, torch.zeros(len(scenes), 0, 0, 3, dtype=torch.uint8)
        if shown is not None:
            self.state, self.image = map(torch.from_numpy, shown)
        wordings = max(len(kind.wordings) for kind in kinds)
        self._words = torch.stack(
            [
                encode([kind.wordings[i % len(kind.wordings)] for i in range(wordings)], text_length)
                for kind in kinds
            ]
        )
        cells = [self._cells(kind) for kind in kinds]
        self._answers = torch.tensor([len(kind.answers) for kind in kinds])
        self._first_cell = self._answers.cumsum(0) - self._answers
        self._answer_ids = torch.tensor([word_id(answer) for kind in kinds for answer in kind.answers])
        sizes = torch.tensor([len(rows) for kind_cells in cells for rows in kind_cells])
        self._cell_sizes, self._cell_starts = sizes, sizes.cumsum(0) - sizes
        self._rows = torch.cat([rows for kind_cells in cells for rows in kind_cells])

    def _cells(self, kind: QuestionKind) -> list[Tensor]:
        """Return, for each answer of a kind, the rows of the states that give it."""
        answers = torch.from_numpy(kind.answer(self.scenes.numpy()))
        cells = [torch.nonzero(answers == index)[:, 0] for index in range(len(kind.answers))]
        for answer, rows in zip(kind.answers, cells, strict=True):
            if not len(rows):
                raise InputError(
                    f"No state gives the answer {answer!r} to the question {kind.name!r}: "
                    f"{kind.wordings[0]!r}. There are {len(answers)} states here; more question_episodes in "
                    "the budget give more, to the questions of the test, too."
                )
        return cells

    def __len__(self) -> int:
        """Return the number of states."""
        return len(self.scenes)

    @property
    def bytes(self) -> int:
        """Memory of the states and the lists of questions, in bytes."""
        return self.state.nbytes + self.image.nbytes + self._rows.nbytes + self._words.nbytes

    def sample(self, count: int, generator: torch.Generator) -> QuestionBatch:
        """Return `count` questions: each draws a kind, then one of its answers, a state and a wording."""
        return self.ask(torch.randint(len(self.kinds), (count,), generator=generator), generator)

    def ask(self, kind: Tensor, generator: torch.Generator) -> QuestionBatch:
        """Return one question for each entry of `kind`, the index of a kind, (count,)."""
        draws = torch.rand(3, len(kind), generator=generator)
        cell = self._first_cell[kind] + (draws[0] * self._answers[kind]).long()
        row = self._rows[self._cell_starts[cell] + (draws[1] * self._cell_sizes[cell]).long()]
        wording = (draws[2] * self._words.shape[1]).long()
        words, answers = self._words[kind, wording], self._answer_ids[cell]
        return QuestionBatch(self.state[row], words, answers, self.image[row])


def load_questions(scenario: Scenario) -> tuple[Questions, Questions]:
    """Return the training and the test questions of a scenario.

    Raises:
        RenderingError: The scenario has a camera, and no back end of this machine can draw.
    """
    check_questions()
    kinds = resolve(scenario.questions)
    scenes = load_file(scenes_folder(scenario) / "scenes.safetensors")
    first = scenario.scene_tasks[0]
    train, test = (
        Questions(kinds, scenes[split], observed(first, scenes[split].numpy()), scenario.text_length)
        for split in ("train", "test")
    )
    return train, test


def scored_questions(questions: Questions, count: int) -> tuple[Tensor, QuestionBatch]:
    """Return the kinds (count,) and the questions of every test, which all methods and seeds share."""
    kind = torch.arange(count) % len(questions.kinds)
    return kind, questions.ask(kind, torch_generator("report questions"))
