"""The reference rows: what joint training trains on, what training from scratch starts from."""

import pytest
import torch
from helpers import build_method

from clbench.base.errors import InputError
from clbench.learning.adaptation import adapt
from clbench.learning.method import Progress, Stage
from clbench.learning.prior import Nothing, Prior, Source, Uses
from clbench.learning.registry import load_method
from clbench.policy.kinds import new_policy
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.budget import Budget
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


@pytest.mark.parametrize("progress", [Progress(0, 1000), Progress(999, 1000), Progress(40, 50, True)])
def test_the_loss_of_joint_weighs_answers_the_same_at_every_step(progress: Progress) -> None:
    policy, method = TransformerPolicy(SMALL), build_method("joint", {})
    batch, questions = toy_source("right").sample(8), toy_questions().sample(8)
    expected = policy.action_loss(batch).mean() + policy.answer_loss(questions).mean()
    assert method.loss(policy, (batch, questions), progress).item() == pytest.approx(expected.item())


@pytest.mark.parametrize(
    ("name", "uses"),
    [
        ("joint", Uses(demonstrations="throughout", questions="throughout", reference=True)),
        ("frozen", Uses(reference=True)),
        ("from_scratch", Uses(reference=True)),
    ],
)
def test_a_reference_row_does_not_compete(name: str, uses: Uses) -> None:
    assert load_method(name).uses == uses


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


class Downloaded(TransformerPolicy):
    """A new one has pretrained weights of its own."""

    pretrained = True


def test_a_policy_with_pretrained_weights_of_its_own_has_no_row_from_scratch() -> None:
    stage = Stage(1, TOY.task("right"), 11, 3, toy_source("right"), Prior({}))
    with pytest.raises(InputError, match="needs untrained weights, and a new Downloaded has pretrained ones"):
        build_method("from_scratch", {}).start_task(Downloaded(SMALL), stage)


def test_from_scratch_is_plain_fine_tuning_of_a_new_policy() -> None:
    scratch, plain = TransformerPolicy(SMALL, seed=3), new_policy(SMALL, seed=11)
    for policy, name in ((scratch, "from_scratch"), (plain, "sft")):
        stage = Stage(1, TOY.task("right"), 11, 3, toy_source("right"), Prior({}))
        assert adapt(policy, build_method(name, {}), stage, Budget(learning_rate=1e-3)) == 3
    expected = dict(plain.named_parameters())
    assert all(value.equal(expected[name]) for name, value in scratch.named_parameters())
    start = new_policy(SMALL, seed=11).get_parameter("head.embed.weight")
    assert not expected["head.embed.weight"].equal(start)
