"""Joint training and training from scratch: what they train on, and what they start from."""

import pytest
import torch
from helpers import build_method

from clbench.learning.method import Progress, Stage
from clbench.learning.prior import Nothing, Prior, Source
from clbench.policy.kinds import new_policy
from clbench.policy.transformer import TransformerPolicy
from clbench.testing import TOY
from clbench.testing.small import SMALL, toy_questions, toy_source

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("skills", [("left", "up"), ()])
def test_joint_trains_on_the_target_as_many_prior_samples_and_half_as_many_questions(
    skills: tuple[str, ...],
) -> None:
    size = TOY.budget.batch_size
    known = toy_source(*skills) if skills else Source(Nothing(), torch.Generator(), size)
    prior = Prior({"demonstrations": known, "questions": toy_questions()})
    batch, questions = build_method("joint", {}).batch(toy_source("right"), prior)
    actions = [tuple(action) for action in batch.action[:, 0].tolist()]
    assert actions[:size] == [(1.0, 0.0)] * size
    assert len(actions) == (2 * size if skills else size)
    assert set(actions[size:]) == ({(-1.0, 0.0), (0.0, 1.0)} if skills else set())
    assert len(questions) == size // 2


def test_the_loss_of_joint_is_the_sum_of_both_means() -> None:
    policy, method = TransformerPolicy(SMALL), build_method("joint", {})
    prior = Prior({"demonstrations": toy_source("left"), "questions": toy_questions()})
    batch, questions = method.batch(toy_source("right"), prior)
    actions = torch.stack([policy.action_loss(batch[row : row + 1])[0] for row in range(len(batch))])
    answers = torch.stack([policy.answer_loss(questions[row : row + 1])[0] for row in range(len(questions))])
    loss = method.loss(policy, (batch, questions), Progress(0, 10))
    torch.testing.assert_close(loss, actions.mean() + answers.mean())


def test_every_target_starts_from_new_weights_and_the_known_normalisation() -> None:
    policy, method = TransformerPolicy(SMALL), build_method("from_scratch", {})
    policy.normalise_like(torch.randn(50, 4) + 3.0, torch.randn(50, 2))
    known = {name: value.clone() for name, value in policy.named_buffers()}
    for number, seed in ((1, 11), (2, 12)):
        stage = Stage(number, TOY.task("right"), seed, 10, toy_source("right"), Prior({}))
        trained = list(method.start_task(policy, stage))
        assert len(trained) == len(list(policy.parameters()))
        fresh = dict(new_policy(SMALL, seed=seed).named_parameters())
        assert all(value.equal(fresh[name]) for name, value in policy.named_parameters())
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter.add_(1.0)
    assert known
    assert all(value.equal(known[name]) for name, value in policy.named_buffers())
