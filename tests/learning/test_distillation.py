import numpy as np
import pytest
import torch

from clbench.data.demonstrations import Demonstrations, load_demonstrations
from clbench.learning.distillation import (
    discrete_head,
    distillation_loss,
    distilled,
    shares,
    with_blocks,
)
from clbench.learning.pretraining import pretrained_policy
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.testing.toy import TOY

DISCRETE = TOY.with_policy("discrete_diffusion")


@pytest.fixture(scope="module", name="teacher")
def _teacher() -> Policy:
    return pretrained_policy(DISCRETE, 0)[0]


@pytest.fixture(scope="module", name="demonstrations")
def _demonstrations(teacher: Policy) -> Demonstrations:
    return Demonstrations.cat(
        [load_demonstrations(task, DISCRETE, teacher.config) for task in DISCRETE.pretrained]
    )


def test_shares_of_masked_tokens_grow_along_the_chunk_within_their_bounds() -> None:
    draws = torch.rand(2000, 8, generator=torch.Generator().manual_seed(0))
    drawn = shares(draws)
    assert (drawn.diff(dim=1) >= 0).all()
    assert drawn.min() >= 0.2
    assert drawn.max() <= 0.7
    # the means of the first and of the last: .45, and .45 + (.7 - .45) / 2
    assert drawn[:, 0].mean() == pytest.approx(0.45, abs=0.02)
    assert drawn[:, -1].mean() == pytest.approx(0.575, abs=0.02)
    assert shares(draws[:, :1]).shape == (2000, 1)


@pytest.mark.parametrize("block", [1, 2, 4])
def test_the_loss_is_the_cross_entropy_to_the_teacher_over_the_share(
    teacher: Policy, demonstrations: Demonstrations, block: int
) -> None:
    generator = torch.Generator().manual_seed(0)
    batch = demonstrations.sample(5, generator)
    student = with_blocks(teacher, block)
    head, teaching = discrete_head(student), discrete_head(teacher)
    share = shares(torch.rand(5, head.chunk // block, generator=generator))
    drawn = torch.rand(5, head.length, generator=generator)
    loss = distillation_loss(teacher, teaching, head, batch, share, drawn)

    total, number = 0.0, 0
    with torch.no_grad():
        hidden, mask = teacher.hidden_states(batch.state, batch.words), teacher.token_mask(batch.words)
    normalised = (batch.action - teacher.action_mean) / teacher.action_std
    truth = head.tokens(normalised)
    for row in range(5):
        counts = np.repeat(batch.valid[row].numpy() > 0, 2)
        level = np.repeat(share[row].numpy(), block * 2)
        hides = (drawn[row].numpy() < level) | ~counts
        tokens = torch.where(torch.from_numpy(hides), head.bins, truth[row])[None]
        one = [layer[row : row + 1] for layer in hidden]
        rows = [
            made.logits(tokens, one, mask[row : row + 1])[0].detach().double().numpy()
            for made in (teaching, head)
        ]
        wanted, found = (np.exp(logit) / np.exp(logit).sum(axis=1, keepdims=True) for logit in rows)
        for place in np.flatnonzero(hides & counts):
            total -= (wanted[place] * np.log(found[place])).sum() / level[place]
            number += 1
    assert float(loss.detach()) == pytest.approx(total / number, rel=1e-4)


def test_the_student_comes_close_to_its_teacher_which_does_not_change(
    teacher: Policy, demonstrations: Demonstrations
) -> None:
    before = {name: value.clone() for name, value in teacher.state_dict().items()}
    student = distilled(teacher, demonstrations, TOY.budget, torch.Generator().manual_seed(1))

    def distance(policy: Policy) -> float:
        """Return the mean KL divergence from the teacher at half-masked chunks."""
        generator = torch.Generator().manual_seed(2)
        batch = demonstrations.sample(64, generator)
        head, teaching = discrete_head(policy), discrete_head(teacher)
        share, drawn = torch.full((64, 1), 0.5), torch.rand(64, head.length, generator=generator)
        with torch.no_grad():
            loss, least = (
                distillation_loss(teacher, teaching, one, batch, share, drawn) for one in (head, teaching)
            )
        return float(loss - least)

    assert 0 <= distance(student) < 0.5 * distance(with_blocks(teacher, 1))
    assert all(value.equal(before[name]) for name, value in teacher.state_dict().items())
    changed = [name for name, value in student.state_dict().items() if not value.equal(before[name])]
    assert all(name.startswith("head.") for name in changed)
    assert all(parameter.requires_grad for parameter in student.parameters())


def test_distillation_repeats_itself(
    teacher: Policy, demonstrations: Demonstrations, monkeypatch: pytest.MonkeyPatch
) -> None:
    sample, deterministic = Demonstrations.sample, set[bool]()

    def watched(self: Demonstrations, count: int, generator: torch.Generator) -> Batch:
        deterministic.add(torch.are_deterministic_algorithms_enabled())
        return sample(self, count, generator)

    monkeypatch.setattr(Demonstrations, "sample", watched)
    students = [
        distilled(teacher, demonstrations, TOY.budget, torch.Generator().manual_seed(3), block=2)
        for _ in range(2)
    ]
    first, second = (student.state_dict() for student in students)
    assert all(value.equal(second[name]) for name, value in first.items())
    assert students[0].config.block == 2
    assert deterministic == {True}


def test_a_policy_without_tokens_has_no_students() -> None:
    with pytest.raises(TypeError, match="'flow' has no tokens"):
        discrete_head(pretrained_policy(TOY, 0)[0])
