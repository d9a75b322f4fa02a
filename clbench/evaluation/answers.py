"""Answers of a policy to questions."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from clbench.data.questions import QuestionKind
from clbench.evaluation.episodes import LANES
from clbench.policy.batch import QuestionBatch
from clbench.policy.policy import Policy, evaluating


@torch.inference_mode()
def answer(
    policy: Policy, kinds: Sequence[QuestionKind], kind: torch.Tensor, questions: QuestionBatch
) -> list[tuple[str, int, int]]:
    """Return, for each kind of question, its name and the numbers of its questions and correct answers.

    A policy that cannot answer is asked nothing.

    Args:
        policy: Policy that answers with the most likely word of the whole vocabulary.
        kinds: All kinds of questions.
        kind: Index of each question's kind, (B,).
        questions: B questions.
    """
    if "answers" not in policy.abilities:
        return [(entry.name, 0, 0) for entry in kinds]
    with evaluating(policy):
        correct = _correct(policy, questions)
    return [
        (entry.name, int((kind == index).sum()), int(correct[kind == index].sum()))
        for index, entry in enumerate(kinds)
    ]


def _correct(policy: Policy, questions: QuestionBatch) -> torch.Tensor:
    """Return which questions a policy answers correctly, (B,)."""
    right = []
    device = policy.device
    for start in range(0, len(questions), LANES):
        rows = slice(start, start + LANES)
        padding = LANES - len(questions.state[rows])
        state = torch.nn.functional.pad(questions.state[rows], (0, 0, 0, padding))
        words = torch.nn.functional.pad(questions.words[rows], (0, 0, 0, padding), value=1)
        image = torch.nn.functional.pad(questions.image[rows], (0, 0, 0, 0, 0, 0, 0, padding))
        word = policy.answer_logits(state.to(device), words.to(device), image.to(device)).argmax(dim=1).cpu()
        right.append(word[: LANES - padding] == questions.answer[rows])
    return torch.cat(right)
