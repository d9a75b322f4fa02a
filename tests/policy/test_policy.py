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
from clbench.policy.vision import Vision

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


def test_making_a_policy_leaves_the_global_generators_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []  # of GPUs
    monkeypatch.setattr("torch.cuda.manual_seed_all", seeds.append)
    before = torch.get_rng_state()
    TransformerPolicy(CONFIG, seed=3)
    assert torch.get_rng_state().equal(before)
    assert seeds == []
    torch.manual_seed(3)
    assert seeds == [3]


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


def _in_the_units_of_a_world(batch: Batch) -> tuple[Batch, Batch]:
    """Return a batch of other units, and the same with numbers of mean 0 and deviation 1."""
    scaled = dataclasses.replace(
        batch,
        state=batch.state * torch.tensor([0.1, 5.0, 1.0, 2.0, 0.5]) + 3,
        action=batch.action * torch.tensor([0.2, 4.0, 1.0]) - 2,
    )
    state, first = scaled.state.double(), scaled.action[:, 0].double()
    plain = dataclasses.replace(
        batch,
        state=((state - state.mean(0)) / state.std(0, correction=0)).float(),
        action=((scaled.action.double() - first.mean(0)) / first.std(0, correction=0)).float(),
    )
    return scaled, plain


def test_losses_predictions_and_actions_do_not_depend_on_the_units_of_the_world() -> None:
    policy, other = TransformerPolicy(CONFIG), TransformerPolicy(CONFIG)
    scaled, plain = _in_the_units_of_a_world(_batch(50))
    policy.normalise_like(scaled.state, scaled.action[:, 0])
    torch.testing.assert_close(policy.action_loss(scaled), other.action_loss(plain), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(policy.predict(scaled), other.predict(plain), rtol=1e-3, atol=1e-4)
    first = scaled.action[:, 0].double().numpy()
    expected = other.act(plain.state, plain.words, plain.noise).double().numpy()
    expected = expected * first.std(axis=0) + first.mean(axis=0)
    found = policy.act(scaled.state, scaled.words, scaled.noise)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


class _ByHand:
    """The equations of the policy in NumPy, with its weights."""

    def __init__(self, policy: TransformerPolicy) -> None:
        self.weights = {name: value.double().numpy() for name, value in policy.state_dict().items()}

    def linear(self, values: Any, name: str) -> Any:
        return values @ self.weights[f"{name}.weight"].T + self.weights[f"{name}.bias"]

    def norm(self, values: Any, name: str) -> Any:
        away = values - values.mean(axis=-1, keepdims=True)
        scaled = away / np.sqrt((away**2).mean(axis=-1, keepdims=True) + 1e-5)
        return scaled * self.weights[f"{name}.weight"] + self.weights[f"{name}.bias"]

    def attention(self, own: Any, memory: Any, read: Any, name: str) -> Any:
        width, size = own.shape[-1], own.shape[-1] // CONFIG.heads
        query, both = self.linear(own, f"{name}.query"), self.linear(memory, f"{name}.key_value")
        mixed = np.zeros_like(own)
        for first in range(0, width, size):
            part, other = slice(first, first + size), slice(width + first, width + first + size)
            scores = query[..., part] @ both[..., part].swapaxes(1, 2) / np.sqrt(size)
            shares = np.exp(scores) * read[:, None]
            mixed[..., part] = shares / shares.sum(axis=-1, keepdims=True) @ both[..., other]
        return self.linear(mixed, f"{name}.out")

    def layer(self, tokens: Any, read: Any, name: str, prefix: Any = None) -> Any:
        own = self.norm(tokens, f"{name}.attention_norm")
        known = [] if prefix is None else [self.norm(prefix, f"{name}.attention_norm")]
        tokens = tokens + self.attention(
            own, np.concatenate([*known, own], axis=1), read, f"{name}.attention"
        )
        inner = self.linear(self.norm(tokens, f"{name}.feed_forward.0"), f"{name}.feed_forward.1")
        return tokens + self.linear(np.maximum(inner, 0), f"{name}.feed_forward.3")

    def hidden(self, state: Any, words: Any) -> tuple[list[Any], Any]:
        """Return the hidden states of the layers, and which of their tokens are read."""
        count, width = len(state), CONFIG.width
        seen = self.linear(state, "backbone.observation").reshape(count, 4, width)
        readout = np.repeat(self.weights["backbone.readout"], count, axis=0)
        tokens = np.concatenate([seen, readout, self.weights["backbone.words.weight"][words]], axis=1)
        tokens = tokens + self.weights["backbone.position"]
        read = np.concatenate([np.ones((count, 5)), words != 0], axis=1)
        layers = []
        for number in range(CONFIG.layers):
            tokens = self.layer(tokens, read, f"backbone.layers.{number}")
            layers.append(tokens)
        return layers, read

    def velocity(self, noisy: Any, time: Any, hidden: list[Any], read: Any) -> Any:
        angle = time[:, None] * np.geomspace(1, 1000, 16)
        clock = self.linear(np.concatenate([np.sin(angle), np.cos(angle)], axis=1), "head.time.0")
        clock = self.linear(clock / (1 + np.exp(-clock)), "head.time.2")
        tokens = self.linear(noisy, "head.embed") + self.weights["head.position"] + clock[:, None]
        read = np.concatenate([read, np.ones((len(noisy), CONFIG.chunk))], axis=1)
        for number, prefix in enumerate(hidden):
            tokens = self.layer(tokens, read, f"head.layers.{number}", prefix)
        return self.linear(self.norm(tokens, "head.velocity_out.0"), "head.velocity_out.1")


def test_hidden_states_answers_and_velocities_follow_from_the_equations_of_the_policy() -> None:
    policy, batch = TransformerPolicy(CONFIG), _batch(4)
    assert isinstance(policy.head, FlowHead)
    by_hand, words = _ByHand(policy), batch.words.numpy()
    layers, read = by_hand.hidden(batch.state.double().numpy(), words)
    hidden = policy.hidden_states(batch.state, batch.words)
    for found, expected in zip(hidden, layers, strict=True):
        np.testing.assert_allclose(found.detach(), expected, rtol=1e-3, atol=1e-4)
    answers = by_hand.linear(by_hand.norm(layers[-1][:, 4], "backbone.answer.0"), "backbone.answer.1")
    found = policy.answer_logits(batch.state, batch.words).detach()
    np.testing.assert_allclose(found, answers, rtol=1e-3, atol=1e-4)
    velocity = by_hand.velocity(batch.noise.double().numpy(), batch.draw.double().numpy(), layers, read)
    found = policy.head.velocity(batch.noise, batch.draw, hidden, policy.token_mask(batch.words)).detach()
    np.testing.assert_allclose(found, velocity, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_number_of_a_state_counts_up_to_ten_deviations_on_each_side(side: int) -> None:
    policy, batch = TransformerPolicy(CONFIG), _batch(2)
    policy.normalise_like(torch.randn(100, 5) * 3 + 7)

    def at(deviations: float) -> Tensor:
        state = batch.state.clone()
        state[:, 1] = policy.state_mean[1] + side * deviations * policy.state_std[1]
        return policy.hidden_states(state, batch.words)[-1]

    torch.testing.assert_close(at(40.0), at(10.0), rtol=1e-4, atol=1e-5)
    assert (at(9.0) - at(10.0)).abs().max() > 1e-3


def test_an_action_is_where_five_steps_along_the_velocity_lead_from_the_noise() -> None:
    policy, batch = TransformerPolicy(CONFIG), _batch(4)
    assert isinstance(policy.head, FlowHead)
    hidden, mask = policy.hidden_states(batch.state, batch.words), policy.token_mask(batch.words)
    chunk = batch.noise
    for time in (1.0, 0.8, 0.6, 0.4, 0.2):  # from noise at 1 to the action at 0
        chunk = chunk - 0.2 * policy.head.velocity(chunk, torch.full((4,), time), hidden, mask)
    torch.testing.assert_close(policy.act(batch.state, batch.words, batch.noise), chunk.detach())


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
        (
            _set(width=1, heads=1, layers=65_536),
            "65,536 layers need at least as many tensors, but the file has",
        ),
        (_set(width=65_536), "a policy of its sizes has at least .* numbers, but the file has"),
        (_set(image_size=65_536), "a policy of its sizes has at least .* numbers, but the file has"),
        (_set(image_size=20), "pictures of 20 pixels cannot be cut into patches of 16"),
        (_set(executed=9), "executed must be at most 8, the steps of a chunk, not 9"),
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


class Merging(nn.Linear):
    """Merges its adapter while it is in evaluation mode, as those of some libraries do."""

    merged = False

    def train(self, mode: bool = True) -> "Merging":
        self.merged = not mode
        return super().train(mode)


@pytest.mark.parametrize("training", [True, False])
def test_a_policy_is_evaluated_without_dropout_and_then_as_it_was(training: bool) -> None:
    policy = TransformerPolicy(CONFIG)
    policy.adapter = Merging(1, 1)
    policy.train(training)
    policy.head.train(not training)  # a part may have a mode of its own
    policy.adapter.train(not training)
    before = [module.training for module in policy.modules()]
    with suppress(KeyError), evaluating(policy):
        assert not any(module.training for module in policy.modules())
        raise KeyError
    assert [module.training for module in policy.modules()] == before
    assert policy.adapter.merged is training


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


@pytest.mark.parametrize(("pixel", "number"), [(0, -1.0), (255, 1.0)])
def test_pixels_are_numbers_from_minus_one_to_one(pixel: int, number: float) -> None:
    vision = Vision(16, 24)
    shown = vision(torch.full((1, 16, 16, 3), pixel, dtype=torch.uint8))
    expected = vision.out(vision.convolutions(torch.full((1, 3, 16, 16), number)).flatten(1))
    torch.testing.assert_close(shown, expected.view(1, 4, 24))


def test_a_policy_with_eyes_refuses_to_act_without_an_image() -> None:
    batch = _batch(2)
    with pytest.raises(ValueError, match=r"images of shape \(32, 32, 3\), not none: pass `batch.image`"):
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
