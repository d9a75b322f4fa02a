"""Positions of hidden states, and the distance between two of them."""

import numpy as np
import pytest
import torch
from scipy import linalg

from clbench.policy.activations import VARIANCE_OFFSET, Gaussian
from clbench.policy.policy import PolicyConfig
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.language import encode

CONFIG = PolicyConfig(state_size=4, action_size=2, width=32, layers=2)
TEXTS = ("go left", "on which side of the target is it", "is it above or below the target")


def _gaussian(seed: int, layers: int = 3, width: int = 6) -> Gaussian:
    generator = torch.Generator().manual_seed(seed)
    return Gaussian(
        torch.randn(layers, width, generator=generator), torch.rand(layers, width, generator=generator) + 0.1
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_distance_is_the_2_wasserstein_distance_of_gaussians_with_diagonal_covariance(seed: int) -> None:
    first, second = _gaussian(seed), _gaussian(seed + 10)
    expected = []
    for layer in range(3):
        means = first.mean[layer].double().numpy(), second.mean[layer].double().numpy()
        left, right = (np.diag(one.deviation[layer].double().numpy() ** 2) for one in (first, second))
        root = linalg.sqrtm(right)
        bures = np.trace(left + right - 2 * linalg.sqrtm(root @ left @ root))
        expected.append(((means[0] - means[1]) ** 2).sum() + bures)
    np.testing.assert_allclose(first.distance(second).numpy(), np.real(expected), rtol=1e-5)


def test_a_distance_is_symmetric_and_zero_only_to_the_same_place() -> None:
    first, second = _gaussian(0), _gaussian(1)
    assert first.distance(second).equal(second.distance(first))
    assert (first.distance(second) > 0).all()
    assert first.distance(first).tolist() == [0.0] * 3


def test_mean_and_deviation_cover_all_tokens_that_are_read() -> None:
    policy, words = TransformerPolicy(CONFIG, seed=1), encode(TEXTS)
    state = torch.randn(len(TEXTS), 4, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        hidden = policy.hidden_states(state, words)
    found = Gaussian.of(hidden, policy.token_mask(words))
    assert found.mean.shape == found.deviation.shape == (2, 32)
    for layer, states in enumerate(hidden):
        # four observation tokens and the readout, then as many words as there are
        rows = np.concatenate(
            [states[row, : 5 + len(text.split())].double().numpy() for row, text in enumerate(TEXTS)]
        )
        assert len(rows) == 3 * 5 + 2 + 8 + 7
        np.testing.assert_allclose(found.mean[layer].numpy(), rows.mean(axis=0), rtol=1e-4, atol=1e-6)
        deviation = np.sqrt(rows.var(axis=0) + VARIANCE_OFFSET)
        np.testing.assert_allclose(found.deviation[layer].numpy(), deviation, rtol=1e-4)


def test_padding_tokens_do_not_count() -> None:
    policy, words = TransformerPolicy(CONFIG), encode(TEXTS)
    mask = policy.token_mask(words)
    hidden = [torch.randn(3, mask.shape[-1], 32, generator=torch.Generator().manual_seed(0))]
    changed = [torch.where(mask[:, 0, 0, :, None], states, 1e3) for states in hidden]
    before, after = Gaussian.of(hidden, mask), Gaussian.of(changed, mask)
    assert before.mean.equal(after.mean)
    assert before.deviation.equal(after.deviation)


def test_channels_that_do_not_vary_have_a_finite_gradient() -> None:
    states = torch.ones(2, 7, 4, requires_grad=True)
    mask = torch.ones(2, 1, 1, 7, dtype=torch.bool)
    gaussian = Gaussian.of([states], mask)
    assert gaussian.deviation.detach().numpy() == pytest.approx(VARIANCE_OFFSET**0.5)
    other = Gaussian(torch.zeros(1, 4), torch.ones(1, 4))
    (gradient,) = torch.autograd.grad(gaussian.distance(other).sum(), states)
    assert torch.isfinite(gradient).all()
