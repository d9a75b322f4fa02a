import dataclasses
import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load, save_file
from scipy import stats
from torch import Tensor, nn

from clbench.learning.optimise import deterministic
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.checkpoint import CheckpointError, load_policy, save_policy
from clbench.policy.flow import FlowHead
from clbench.policy.policy import PolicyConfig, evaluating
from clbench.policy.transformer import TransformerPolicy

CONFIG = PolicyConfig(state_size=5, action_size=3, width=32, layers=2)


def _batch(count: int, seed: int = 0) -> Batch:
    generator = torch.Generator().manual_seed(seed)
    shape = (count, CONFIG.chunk, CONFIG.action_size)
    words = torch.randint(1, 200, (count, 12), generator=generator)
    words[:, 5:] = 0
    return Batch(
        torch.randn(count, CONFIG.state_size, generator=generator),
        words,
        torch.randn(shape, generator=generator),
        torch.ones(count, CONFIG.chunk),
        torch.rand(count, generator=generator),
        torch.randn(shape, generator=generator),
    )


def test_losses_come_per_sample() -> None:
    policy, batch = TransformerPolicy(CONFIG), _batch(7)
    assert policy.action_loss(batch).shape == (7,)
    questions = QuestionBatch(batch.state, batch.words, torch.full((7,), 3))
    assert policy.answer_loss(questions).shape == (7,)
    assert [hidden.shape for hidden in policy.hidden_states(batch.state, batch.words)] == [(7, 17, 32)] * 2


def test_the_same_batch_gives_the_same_loss_and_the_same_seed_the_same_weights() -> None:
    batch = _batch(4)
    first, second, other = (TransformerPolicy(CONFIG, seed=seed).action_loss(batch) for seed in (1, 1, 2))
    assert first.equal(second)
    assert not first.equal(other)


def test_making_a_policy_leaves_the_global_generator_alone() -> None:
    before = torch.get_rng_state()
    TransformerPolicy(CONFIG, seed=3)
    assert torch.get_rng_state().equal(before)


def test_the_flow_loss_is_the_squared_error_of_the_velocity_at_the_drawn_time() -> None:
    policy, batch = TransformerPolicy(CONFIG), _batch(6)
    loss = policy.action_loss(batch).detach().numpy()
    # by hand, in NumPy: x_t = t * noise + (1 - t) * action, u = noise - action, t = quantile of Beta(1.5, 1)
    time = stats.beta(1.5, 1).ppf(batch.draw.numpy()).astype(np.float32)
    noise, action = batch.noise.numpy(), batch.action.numpy()
    noisy = time[:, None, None] * noise + (1 - time[:, None, None]) * action
    hidden = policy.hidden_states(batch.state, batch.words)
    mask = policy.token_mask(batch.words)
    assert isinstance(policy.head, FlowHead)
    velocity = policy.head.velocity(torch.from_numpy(noisy), torch.from_numpy(time), hidden, mask)
    expected = ((velocity.detach().numpy() - (noise - action)) ** 2).mean(axis=(1, 2))
    np.testing.assert_allclose(loss, expected, rtol=1e-4)


def test_the_loss_is_the_mean_over_the_steps_that_count() -> None:
    """The other steps still read a step that does not count, as in a rollout; only its error is left out."""
    policy, batch = TransformerPolicy(CONFIG), _batch(3)
    parts = []
    for step in range(CONFIG.chunk):
        valid = torch.zeros(3, CONFIG.chunk)
        valid[:, step] = 1
        parts.append(policy.action_loss(dataclasses.replace(batch, valid=valid)))
    errors = torch.stack(parts).detach().numpy()
    some = torch.ones(3, CONFIG.chunk)
    some[0, 2:], some[1, 5:] = 0, 0
    loss = policy.action_loss(dataclasses.replace(batch, valid=some)).detach().numpy()
    np.testing.assert_allclose(
        loss, [errors[:2, 0].mean(), errors[:5, 1].mean(), errors[:, 2].mean()], rtol=1e-4
    )


def test_detached_hidden_states_stop_the_gradient_at_the_backbone() -> None:
    policy, batch = TransformerPolicy(CONFIG), _batch(3)
    hidden = [state.detach() for state in policy.hidden_states(batch.state, batch.words)]
    policy.action_loss(batch, hidden).mean().backward()  # type: ignore[no-untyped-call]
    assert all(parameter.grad is None for parameter in policy.backbone.parameters())
    assert all(parameter.grad is not None for parameter in policy.head.parameters())


def test_padding_words_do_not_change_the_actions_of_the_policy() -> None:
    policy, batch = TransformerPolicy(CONFIG), _batch(16)
    changed = policy.backbone.words.weight.data.clone()
    before = policy.act(batch.state, batch.words, batch.noise)
    changed[0] += 1.0
    policy.backbone.words.weight.data.copy_(changed)
    assert policy.act(batch.state, batch.words, batch.noise).equal(before)


def test_normalisation_follows_the_data_it_is_given() -> None:
    policy = TransformerPolicy(CONFIG)
    state = torch.randn(100, 5) * torch.tensor([1.0, 2.0, 3.0, 4.0, 0.0]) + 7
    policy.normalise_like(state, torch.randn(100, 3))
    np.testing.assert_allclose(policy.state_mean, state.numpy().mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(policy.state_std[:4], state.numpy().std(axis=0)[:4], rtol=1e-5)
    assert policy.state_std[4] == pytest.approx(0.01)  # constant channels are not blown up


def test_a_policy_survives_saving(tmp_path: Path) -> None:
    policy, batch = TransformerPolicy(CONFIG, seed=5), _batch(3)
    policy.normalise_like(batch.state, batch.action[:, 0])
    save_policy(policy, tmp_path)
    assert load_policy(tmp_path).action_loss(batch).equal(policy.action_loss(batch))


def test_a_policy_with_tied_weights_survives_saving(tmp_path: Path) -> None:
    policy = TransformerPolicy(CONFIG, seed=5)
    first, second = [module for module in policy.modules() if isinstance(module, nn.LayerNorm)][:2]
    second.weight = first.weight
    with torch.no_grad():
        first.weight.mul_(1.5)
    save_policy(policy, tmp_path)
    loaded = load_policy(tmp_path).state_dict()
    assert all(loaded[name].equal(value) for name, value in policy.state_dict().items())


def _cut(folder: Path) -> None:
    path = folder / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:-100])


def _set(**sizes: Any) -> Callable[[Path], None]:
    """Return a function that writes other sizes into a checkpoint and keeps its tensors."""

    def damage(folder: Path) -> None:
        config = json.loads((folder / "policy.json").read_text())
        (folder / "policy.json").write_text(json.dumps({**config, **sizes}))

    return damage


def _edit(change: Callable[[dict[str, Tensor]], Any]) -> Callable[[Path], None]:
    """Return a function that writes other tensors into a checkpoint."""

    def damage(folder: Path) -> None:
        tensors = load((folder / "policy.safetensors").read_bytes())
        change(tensors)
        save_file(tensors, folder / "policy.safetensors")

    return damage


def _pickle(folder: Path) -> None:
    torch.save(TransformerPolicy(CONFIG).state_dict(), folder / "policy.safetensors")


def _poison(folder: Path) -> None:
    policy = load_policy(folder)
    next(iter(policy.parameters())).data.fill_(float("nan"))
    save_policy(policy, folder)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_cut, "cannot be read as a policy"),
        (lambda folder: (folder / "policy.json").write_text("{"), "cannot be read as a policy"),
        (lambda folder: (folder / "policy.safetensors").unlink(), "cannot be read as a policy"),
        (lambda folder: (folder / "policy.json").write_text("[1]"), "cannot be read as a policy"),
        (_pickle, "cannot be read as a policy"),
        (_set(depth=64), "cannot be read as a policy"),
        (_set(width=36), "tensors that do not fit the policy: .*position"),
        (_set(width="32"), "width must be a whole number from 1 to 65,536, not '32'"),
        (_set(layers=10**12), "layers must be a whole number from 1 to 65,536"),
        (_set(heads=5), "width 32 cannot be shared among 5 heads"),
        (_set(width=1, heads=1, layers=65_536), "65,536 layers cannot have"),
        (_set(width=65_536), "a policy of its sizes has at least .* numbers, but the file has"),
        (_set(image_size=65_536), "a policy of its sizes has at least .* numbers, but the file has"),
        (_set(image_size=20), "pictures of 20 pixels cannot be cut into patches of 16"),
        (_set(executed=9), "a chunk of 8 steps has no 9 to execute"),
        (_edit(lambda them: them.pop("state_std")), "tensors that do not fit the policy: state_std"),
        (_edit(lambda them: them.update(more=torch.zeros(1))), "do not fit the policy: more"),
        (_edit(lambda them: them.update(state_std=them["state_std"].half())), "do not fit .*: state_std"),
        (_poison, "not finite"),
    ],
)
def test_a_damaged_checkpoint_is_refused_by_name(
    tmp_path: Path, damage: Callable[[Path], None], message: str
) -> None:
    save_policy(TransformerPolicy(CONFIG), tmp_path)
    damage(tmp_path)
    with pytest.raises(CheckpointError, match=message) as error:
        load_policy(tmp_path)
    assert str(tmp_path) in str(error.value)


@pytest.mark.parametrize("training", [True, False])
def test_a_policy_is_evaluated_without_dropout_and_then_as_it_was(training: bool) -> None:
    policy = TransformerPolicy(CONFIG).train(training)
    with suppress(KeyError), evaluating(policy):
        assert not any(module.training for module in policy.modules())
        raise KeyError
    assert all(module.training == training for module in policy.modules())


# ---- images ------------------------------------------------------------------------------------------------


SEEING = dataclasses.replace(CONFIG, image_size=32)


def _seen(count: int, seed: int = 0) -> Batch:
    generator = torch.Generator().manual_seed(seed)
    image = torch.randint(0, 256, (count, 32, 32, 3), generator=generator).to(torch.uint8)
    return dataclasses.replace(_batch(count, seed), image=image)


def test_a_batch_without_images_has_a_row_of_no_pixels_for_each_sample() -> None:
    batch = _batch(3)
    assert batch.image.shape == (3, 0, 0, 3)
    assert Batch.cat([batch, batch]).image.shape == (6, 0, 0, 3)
    assert not any("vision" in name for name in TransformerPolicy(CONFIG).state_dict())


def test_a_policy_reads_an_image_in_four_tokens() -> None:
    policy, batch = TransformerPolicy(SEEING), _seen(3)
    hidden = policy.hidden_states(batch.state, batch.words, batch.image)
    assert hidden[0].shape == (3, 4 + 4 + 1 + 12, 32)
    assert policy.token_mask(batch.words).shape == (3, 1, 1, 21)
    questions = QuestionBatch(batch.state, batch.words, torch.full((3,), 3), batch.image)
    dark = dataclasses.replace(batch, image=torch.zeros_like(batch.image))
    assert policy.action_loss(batch).shape == policy.answer_loss(questions).shape == (3,)
    assert not policy.action_loss(batch).equal(policy.action_loss(dark))
    eyes = [weight for name, weight in policy.named_parameters() if "vision" in name]
    gradients = torch.autograd.grad(policy.action_loss(batch).mean(), eyes)
    assert all(gradient.abs().sum() > 0 for gradient in gradients)


def test_a_policy_with_eyes_refuses_to_act_without_an_image() -> None:
    batch = _batch(2)
    with pytest.raises(ValueError, match=r"image of \(32, 32, 3\), not none: hand over `batch.image`"):
        TransformerPolicy(SEEING).hidden_states(batch.state, batch.words)
    with pytest.raises(ValueError, match=r"not \(0, 0, 3\)"):
        TransformerPolicy(SEEING).action_loss(batch)
    with pytest.raises(ValueError, match="image_size must be a multiple of 16, not 30"):
        TransformerPolicy(dataclasses.replace(CONFIG, image_size=30))


def test_rows_of_a_forward_with_images_do_not_depend_on_their_place() -> None:
    policy, batch = TransformerPolicy(SEEING), _seen(40)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    with deterministic():
        chunks = policy.act(batch.state, batch.words, batch.noise, batch.image)
        moved = policy.act(batch.state[order], batch.words[order], batch.noise[order], batch.image[order])
    assert moved.equal(chunks[order])


def test_a_checkpoint_keeps_the_eyes(tmp_path: Path) -> None:
    policy, batch = TransformerPolicy(SEEING, seed=2), _seen(4)
    save_policy(policy, tmp_path)
    loaded = load_policy(tmp_path)
    assert loaded.config == SEEING
    assert loaded.action_loss(batch).equal(policy.action_loss(batch))


@pytest.mark.parametrize(
    "rows", [slice(1, 3), [2, 0], torch.tensor([False, True, True, False]), torch.tensor([3])]
)
def test_batches_can_be_indexed_and_joined_so_that_a_buffer_takes_few_lines(rows: Any) -> None:
    def sample(count: int) -> Batch:
        size = (count, 8, 2)
        words = torch.randint(9, (count, 12))
        return Batch(
            torch.randn(count, 4),
            words,
            torch.randn(size),
            torch.ones(size[:2]),
            torch.rand(count),
            torch.randn(size),
        )

    batch = sample(4)
    chosen = batch[rows]
    assert torch.equal(chosen.state, batch.state[rows])
    assert torch.equal(chosen.noise, batch.noise[rows])
    joined = Batch.cat([chosen, batch])
    assert len(joined) == len(chosen) + 4
    assert torch.equal(joined.words[len(chosen) :], batch.words)


def test_a_batch_is_shown_in_one_line() -> None:
    shapes = "state (2, 5), words (2, 12), action (2, 8, 3), valid (2, 8), draw (2,), noise (2, 8, 3)"
    assert repr(_batch(4)[:2]) == f"<Batch of 2 samples: {shapes}>"
