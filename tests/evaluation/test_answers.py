"""Answers to questions: they are counted by kind, for any number of questions."""

from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from clbench.data.questions import QuestionKind
from clbench.evaluation.answers import answer
from clbench.evaluation.episodes import LANES
from clbench.policy.batch import QuestionBatch
from clbench.policy.policy import Policy
from clbench.testing.small import SMALL

NAMES = ("colour", "place", "size")
KINDS = tuple(
    QuestionKind(name, ("what is it",), ("left", "right"), lambda state: state.astype(np.int64))
    for name in NAMES
)


class Adding(Policy):
    """A policy whose answer is the sum of what it reads: a number of the state, a word, and a pixel."""

    abilities: ClassVar[frozenset[str]] = frozenset({"answers"})

    def answer_logits(self, state: Tensor, words: Tensor, image: Tensor | None = None) -> Tensor:
        assert image is not None
        assert len(state) == LANES  # as many rows in every forward pass
        place = state[:, 0].long() + words[:, 0] + image[:, 0, 0, 0]
        return torch.eye(200)[place.long()]

    def action_loss(self, *_: Any) -> Tensor:
        raise NotImplementedError

    predict = act = action_loss  # type: ignore[assignment]


class Silent(Adding):
    """The same without the ability."""

    abilities: ClassVar[frozenset[str]] = frozenset()


def _questions(count: int) -> tuple[Tensor, QuestionBatch]:
    """Return kinds and questions, of which the policy answers about two thirds rightly."""
    draw = torch.Generator().manual_seed(0)
    state, words = (torch.randint(0, 50, (count, 3), generator=draw) for _ in range(2))
    image = torch.randint(0, 50, (count, 2, 2, 3), generator=draw).to(torch.uint8)
    right = state[:, 0] + words[:, 0] + image[:, 0, 0, 0]
    wrong = torch.rand(count, generator=draw) < 0.33
    kind = torch.randint(0, len(NAMES), (count,), generator=draw)
    return kind, QuestionBatch(state.float(), words, right + wrong.long(), image)


def test_right_answers_are_counted_for_each_kind_also_of_the_last_few_questions() -> None:
    policy = Adding(SMALL)
    for count in (1, LANES, 2 * LANES + 15):
        kind, questions = _questions(count)
        expected = {name: [0, 0] for name in NAMES}
        for row in range(count):
            told = questions.state[row, 0] + questions.words[row, 0] + questions.image[row, 0, 0, 0]
            counts = expected[NAMES[int(kind[row])]]
            counts[0] += 1
            counts[1] += int(told) == int(questions.answer[row])
        assert answer(policy, KINDS, kind, questions) == [(name, *expected[name]) for name in NAMES]


def test_a_policy_that_cannot_answer_is_asked_nothing() -> None:
    assert answer(Silent(SMALL), KINDS, *_questions(5)) == [(name, 0, 0) for name in NAMES]
