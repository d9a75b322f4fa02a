"""Probes of a policy: how many weights have moved, and where its hidden states lie, against plain loops."""

import dataclasses

import numpy as np
import torch

from clbench.evaluation.probes import activations, predictions, shift, update_sparsity
from clbench.policy.transformer import TransformerPolicy
from clbench.testing.small import SMALL, toy_questions, toy_source


def test_update_sparsity_counts_single_weights_that_moved_by_less_than_a_thousandth_of_themselves() -> None:
    pretrained, policy = TransformerPolicy(SMALL, seed=1), TransformerPolicy(SMALL, seed=1)
    assert update_sparsity(policy, pretrained) == 1.0
    factors = (1.0, 1.0 + 0.9e-3, 1.0 - 0.9e-3, 1.0 + 1.2e-3, 1.0 - 1.2e-3, 2.0)
    still = total = 0
    with torch.no_grad():
        for number, (old, new) in enumerate(zip(pretrained.parameters(), policy.parameters(), strict=True)):
            old.fill_(0.5 / (number + 1))  # as large as it may be: the change is a share of the weight
            factor = factors[number % len(factors)]
            new.copy_(factor * old)
            total += old.numel()
            still += old.numel() * (abs(factor - 1) < 1e-3)
    assert 0.1 < still / total < 0.9
    assert update_sparsity(policy, pretrained) == still / total


def test_the_change_of_a_weight_is_a_share_of_what_it_was_and_not_of_what_it_is() -> None:
    pretrained, policy = TransformerPolicy(SMALL), TransformerPolicy(SMALL)
    with torch.no_grad():
        for old, new in zip(pretrained.parameters(), policy.parameters(), strict=True):
            old.fill_(1.0)
            new.fill_(1.0 + 1.0005e-3)  # 0.9995e-3 of what it is
    assert update_sparsity(policy, pretrained) == 0.0


def test_a_weight_that_was_0_has_moved_if_it_is_more_than_a_hundred_billionth() -> None:
    pretrained, policy = TransformerPolicy(SMALL), TransformerPolicy(SMALL)
    with torch.no_grad():
        for weight in (*pretrained.parameters(), *policy.parameters()):
            weight.zero_()
        first = next(policy.parameters())
        first.view(-1)[0], first.view(-1)[1] = 0.5e-11, 2e-11
    total = sum(weight.numel() for weight in policy.parameters())
    assert update_sparsity(policy, pretrained) == (total - 1) / total


def test_parameters_that_are_not_trained_count_as_unchanged() -> None:
    pretrained, policy = TransformerPolicy(SMALL), TransformerPolicy(SMALL)
    for weight in pretrained.parameters():
        weight.requires_grad_(False)
    with torch.no_grad():
        next(policy.parameters()).add_(1.0)
    moved, total = (
        sum(one.numel() for one in some) for some in ([next(policy.parameters())], policy.parameters())
    )
    assert update_sparsity(policy, pretrained) == (total - moved) / total


def test_a_policy_with_other_parameters_has_no_update_sparsity() -> None:
    larger = TransformerPolicy(dataclasses.replace(SMALL, layers=3))
    assert update_sparsity(larger, TransformerPolicy(SMALL)) is None


def test_activations_are_those_of_the_tokens_that_are_read() -> None:
    policy, questions = TransformerPolicy(SMALL, seed=2), toy_questions(1).sample(20)
    found = activations(policy, questions)
    with torch.no_grad():
        hidden = policy.hidden_states(questions.state, questions.words)
    read = policy.token_mask(questions.words)[:, 0, 0]
    assert 0 < int(read.sum()) < read.numel()  # there is padding
    for layer, states in enumerate(hidden):
        rows = np.array([states[place].double().numpy() for place in map(tuple, read.nonzero().tolist())])
        np.testing.assert_allclose(found.mean[layer], rows.mean(axis=0), atol=1e-5)
        np.testing.assert_allclose(found.deviation[layer], np.sqrt(rows.var(axis=0) + 1e-6), atol=1e-5)


def test_the_shift_weighs_samples_alike_however_many_of_their_actions_are_valid() -> None:
    batch = toy_source("left").sample(4)
    before = predictions(TransformerPolicy(SMALL), batch)
    valid = torch.ones(4, SMALL.chunk)
    valid[0, 1:] = 0
    after = before.clone()
    after[0, 0] += 2.0  # the only valid action of the first sample
    after[0, 1:] += 9.0  # these do not count
    after[1, 0, 0] += 4.0  # one number of sixteen
    assert abs(shift(before, after, valid) - (2.0**2 + 4.0**2 / 16 + 0 + 0) / 4) < 1e-5
