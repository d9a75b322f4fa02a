import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from clbench.policy.batch import Batch
from clbench.policy.checkpoint import CheckpointError, load_policy, save_policy
from clbench.policy.discrete import DiscreteDiffusionHead
from clbench.policy.policy import Policy, PolicyConfig
from clbench.policy.transformer import TransformerPolicy

CONFIG = PolicyConfig(state_size=5, action_size=3, width=32, layers=2, kind="discrete_diffusion")
LENGTH = CONFIG.chunk * CONFIG.action_size


def batch_of(count: int, seed: int = 0) -> Batch:
    generator = torch.Generator().manual_seed(seed)
    valid = torch.ones(count, CONFIG.chunk)
    valid[0, 3:] = 0
    return Batch(
        state=torch.randn(count, CONFIG.state_size, generator=generator),
        words=torch.randint(1, 200, (count, 12), generator=generator),
        action=torch.rand(count, CONFIG.chunk, CONFIG.action_size, generator=generator) * 2 - 1,
        valid=valid,
        draw=torch.rand(count, generator=generator),
        noise=torch.randn(count, CONFIG.chunk, CONFIG.action_size, generator=generator),
    )


def head_of(policy: Policy) -> DiscreteDiffusionHead:
    assert isinstance(policy.head, DiscreteDiffusionHead)
    return policy.head


def test_bins_reach_from_the_first_to_the_99th_percentile_and_as_far_to_the_other_side() -> None:
    policy = TransformerPolicy(CONFIG)
    generator = np.random.default_rng(0)
    action = generator.uniform(-0.2, 0.8, (5000, 3)).astype(np.float32)
    action[:, 2] = 0.0  # a dimension that no skill uses
    policy.normalise_like(torch.zeros(1, 5), torch.from_numpy(action))
    centres = policy.head.centres() * policy.action_std[:, None] + policy.action_mean[:, None]  # type: ignore[operator]
    reach = np.abs(np.quantile(action[:, :2], [0.01, 0.99], axis=0)).max(axis=0)
    half = np.append(reach, 1.0) / 256
    expected = np.append(reach, 1.0)[:, None] * np.linspace(-1, 1, 257)[None, :-1] + half[:, None]
    np.testing.assert_allclose(centres.numpy(), expected, atol=1e-5)


def test_an_action_comes_back_from_its_bin_to_within_half_a_bin() -> None:
    head = head_of(TransformerPolicy(CONFIG))
    action = batch_of(50).action
    tokens = head.tokens(action)
    assert tokens.shape == (50, LENGTH)
    back = head.centres()[torch.arange(LENGTH) % 3, tokens].view_as(action)
    assert (back - action).abs().max() <= 1 / 256 + 1e-6
    beyond = head.tokens(torch.tensor([[[-9.0, 9.0, 0.0]] * CONFIG.chunk]))
    assert beyond[0, :2].tolist() == [0, 255]


def test_the_share_of_masked_tokens_follows_the_cosine_and_the_noise_chooses_them() -> None:
    head, batch = head_of(TransformerPolicy(CONFIG)), batch_of(64)
    masked = head.masked(batch.valid, batch.draw, batch.noise).numpy()
    for row in range(64):
        counts = np.repeat(batch.valid[row].numpy() > 0, 3)
        noise = batch.noise[row].numpy().ravel()
        number = max(1, round(counts.sum() * math.cos(math.pi / 2 * float(batch.draw[row]))))
        chosen = np.flatnonzero(counts)[np.argsort(noise[counts], kind="stable")[:number]]
        assert set(np.flatnonzero(masked[row])) == set(chosen) | set(np.flatnonzero(~counts))


def test_the_loss_is_the_mean_cross_entropy_of_the_masked_tokens_that_count() -> None:
    policy, batch = TransformerPolicy(CONFIG, seed=1), batch_of(6)
    head, hidden = head_of(policy), policy.hidden_states(batch.state, batch.words)
    mask = policy.token_mask(batch.words)
    truth, masked = head.tokens(batch.action), head.masked(batch.valid, batch.draw, batch.noise)
    logits = head.logits(torch.where(masked, 256, truth), hidden, mask).detach().double().numpy()
    chances = np.exp(logits) / np.exp(logits).sum(axis=2, keepdims=True)
    losses = policy.action_loss(batch).detach().numpy()
    for row in range(6):
        counts = np.repeat(batch.valid[row].numpy() > 0, 3) & masked[row].numpy()
        right = chances[row, np.arange(LENGTH), truth[row].numpy()]
        np.testing.assert_allclose(losses[row], -np.log(right[counts]).mean(), rtol=1e-5)


def test_the_prediction_is_the_mean_action_over_the_bins_at_the_masked_chunk() -> None:
    policy, batch = TransformerPolicy(CONFIG, seed=1), batch_of(6)
    policy.normalise_like(batch.state, batch.action[:, 0] * torch.tensor([0.2, 1.0, 3.0]) + 0.5)
    head, hidden = head_of(policy), policy.hidden_states(batch.state, batch.words)
    truth = head.tokens((batch.action - policy.action_mean) / policy.action_std)
    shown = torch.where(head.masked(batch.valid, batch.draw, batch.noise), 256, truth)
    logits = head.logits(shown, hidden, policy.token_mask(batch.words)).detach().double().numpy()
    chances = np.exp(logits) / np.exp(logits).sum(axis=2, keepdims=True)
    centres = head.centres().double().numpy()
    expected = np.stack([chances[:, token] @ centres[token % 3] for token in range(LENGTH)], axis=1)
    found = policy.predict(batch).detach().numpy()
    np.testing.assert_allclose(found, expected.reshape(6, CONFIG.chunk, 3), rtol=1e-4, atol=1e-5)


def test_the_loss_does_not_see_tokens_that_do_not_count() -> None:
    policy, batch = TransformerPolicy(CONFIG), batch_of(4)
    other = batch.action.clone()
    other[0, 3:] = 0.7
    assert policy.action_loss(dataclasses.replace(batch, action=other)).equal(policy.action_loss(batch))


def test_an_action_is_a_function_of_the_observation_alone() -> None:
    policy, batch = TransformerPolicy(CONFIG), batch_of(4)
    first = policy.act(batch.state, batch.words, batch.noise)
    assert first.shape == batch.action.shape
    assert first.equal(policy.act(batch.state, batch.words, torch.zeros_like(batch.noise)))


def test_sizes_of_both_policies_are_within_ten_percent() -> None:
    sizes = [
        sum(parameter.numel() for parameter in TransformerPolicy(PolicyConfig(25, 4, kind=kind)).parameters())
        for kind in ("flow", "discrete_diffusion")
    ]
    assert max(sizes) / min(sizes) < 1.1


def test_a_policy_with_blocks_comes_back_from_its_checkpoint(tmp_path: Path) -> None:
    policy = TransformerPolicy(dataclasses.replace(CONFIG, block=2), seed=2)
    save_policy(policy, tmp_path)
    loaded, batch = load_policy(tmp_path), batch_of(3)
    assert head_of(loaded).block == 2
    assert loaded.act(batch.state, batch.words, batch.noise).equal(
        policy.act(batch.state, batch.words, batch.noise)
    )


def test_a_checkpoint_with_blocks_that_do_not_fit_is_refused(tmp_path: Path) -> None:
    save_policy(TransformerPolicy(CONFIG), tmp_path)
    text = (tmp_path / "policy.json").read_text().replace('"block": 0', '"block": 3')
    (tmp_path / "policy.json").write_text(text)
    with pytest.raises(CheckpointError, match="8 steps cannot be cut into blocks of 3"):
        load_policy(tmp_path)


def test_a_checkpoint_of_the_other_kind_is_refused(tmp_path: Path) -> None:
    save_policy(TransformerPolicy(CONFIG), tmp_path)
    tensors = load_file(tmp_path / "policy.safetensors")
    save_policy(TransformerPolicy(dataclasses.replace(CONFIG, kind="flow")), tmp_path)
    save_file(tensors, tmp_path / "policy.safetensors")
    with pytest.raises(CheckpointError, match=r"tensors that do not fit the policy: head\."):
        load_policy(tmp_path)
