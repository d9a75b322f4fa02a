"""The contract of a policy, checked on the toy in seconds; `docs/guide/your_policy.md` describes it.

    def test_my_policy() -> None:
        check_policy("my_policy:MyPolicy")

`clbench.testing.policy_checks` returns a check for each clause, as `method_checks` does for methods.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from clbench.learning.optimise import deterministic, optimise
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.checkpoint import load_policy, save_policy
from clbench.policy.kinds import new_policy, policy_class
from clbench.policy.policy import ABILITIES, Policy, PolicyConfig
from clbench.testing.clauses import Check, ContractError
from clbench.testing.global_state import GENERATORS, read, same
from clbench.testing.small import SMALL, toy_questions, toy_source

SAMPLES = 6
"""Samples in a batch that the checks look at."""

Rows = TypeVar("Rows", Batch, QuestionBatch)

LEARNING_STEPS = 80
"""Optimiser steps within which the loss on the toy's demonstrations must fall by `LEAST_FALL`."""

LEAST_FALL = 0.25
"""Least share by which the loss falls. The built-in policies lose 94 and 90 % of it in these steps."""
FARTHEST = 1.0
"""Greatest mean distance from the demonstrated actions after these steps: half the range of actions."""

PAGE = "docs/guide/your_policy.md"


def check_policy(kind: str, image_size: int = 0) -> None:
    """Check on the toy's data that a policy keeps the protocol of `clbench.Policy`.

    The policy is built with the toy's sizes and normalised like the toy's demonstrations: a class that loads
    pretrained weights must do without them here.

    Args:
        kind: Kind of the policy: a built-in name, or "module:Class".
        image_size: Width and height of the pictures that it sees, such as 64 for `clbench/FetchPixels-v0`; 0
            without pictures. The toy's pictures show its state as stripes.

    Raises:
        UnknownNameError: There is no such kind.
        WrongTypeError: The class is not a subclass of `clbench.Policy`.
        ContractError: The policy breaks a clause; the message shows the expected and the actual behaviour,
            and the place to look at.
    """
    for check in policy_checks(kind, image_size):
        check()


def policy_checks(kind: str, image_size: int = 0) -> list[Check]:
    """Return a check for each clause of the contract, for `pytest.mark.parametrize(..., ids=str)`."""
    subject = Subject(kind, image_size)
    return [Check(deterministic()(_named(clause)), subject) for clause in CLAUSES]


def _named(clause: Callable[[Subject], None]) -> Callable[[Subject], None]:
    """Return a clause that turns an error of the policy into a breach of the contract."""

    @functools.wraps(clause)
    def check(subject: Subject) -> None:
        try:
            clause(subject)
        except ContractError:
            raise
        except Exception as error:
            frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
            module = subject.cls.__module__
            own = [frame.f_code.co_name for frame in frames if frame.f_globals.get("__name__") == module]
            look = f"{own[-1]}()" if own else "the arguments of its functions"
            words = f"{type(error).__name__}: {error}"
            raise _breach(clause, "the policy to run without an error", words, look) from error

    return check


class Subject:
    """A policy, and samples to check it on.

    Args:
        kind: Kind of the policy.
        image_size: Width and height of the pictures that it sees; 0 without pictures.
    """

    def __init__(self, kind: str, image_size: int = 0) -> None:
        self.cls = policy_class(kind)
        self.config: PolicyConfig = dataclasses.replace(SMALL, kind=kind, image_size=image_size)

    def build(self, seed: int = 0) -> Policy:
        """Return a new policy, normalised like the toy's demonstrations."""
        policy, (state, action) = new_policy(self.config, seed), self.known
        policy.normalise_like(state, action)
        return policy

    @cached_property
    def known(self) -> tuple[Tensor, Tensor]:
        """States (N, S) and actions (N, A) of the toy's demonstrations."""
        drawn = toy_source("left", "up").sample(500)
        return drawn.state, drawn.action[:, 0]

    @cached_property
    def batch(self) -> Batch:
        """Some samples; in the first one, the last actions do not count."""
        drawn = self.seen(toy_source("left", "up").sample(SAMPLES))
        valid = drawn.valid.clone()
        valid[0, self.config.chunk // 2 :] = 0
        return dataclasses.replace(drawn, valid=valid)

    def seen(self, batch: Rows) -> Rows:
        """Return a batch with the pictures that the policy sees, if it sees any."""
        size = self.config.image_size
        return dataclasses.replace(batch, image=_stripes(batch.state, size)) if size else batch


# ---- the clauses -------------------------------------------------------------------------------------------


def initial_weights(subject: Subject) -> None:
    """The initial weights depend on the seed alone, and leave the global generators as they are.

    Pretrained weights of the policy's own may be the same for all seeds.
    """
    before = read(GENERATORS)
    first = new_policy(subject.config, 1).state_dict()
    for name, value in read(GENERATORS).items():
        if not same(value, before[name]):
            raise _breach(
                initial_weights, "the global generators to stay as they are", f"{name} changed", "__init__()"
            )
    torch.rand(1)
    second, other = (new_policy(subject.config, seed).state_dict() for seed in (1, 2))
    if not _equal(first, second):
        found = "two policies with seed 1 have different weights"
        raise _breach(initial_weights, "weights that depend on the seed alone", found, "__init__()")
    if _equal(first, other) and not subject.cls.pretrained:
        found = "the seeds 1 and 2 give the same weights"
        raise _breach(initial_weights, "weights that depend on the seed", found, "__init__()")


def losses(subject: Subject) -> None:
    """`action_loss` returns one loss per sample, a function of that sample and of the weights alone."""
    policy, batch = subject.build(), subject.batch
    with _left_alone(losses, batch, "action_loss()"):
        loss = policy.action_loss(batch)
    _check_shape(losses, loss, (SAMPLES,), "action_loss()")
    if not bool(torch.isfinite(loss).all()):
        raise _breach(losses, "finite losses", str(loss.tolist()), "action_loss()")
    if not loss.equal(policy.action_loss(batch)):
        expected = "equal losses on the same batch: all draws come with it, in `draw` and `noise`; no dropout"
        raise _breach(losses, expected, "other losses at the second call", "action_loss()")
    for row in range(SAMPLES):
        alone = policy.action_loss(batch[row : row + 1])
        if not torch.allclose(alone, loss[row : row + 1], rtol=1e-3, atol=1e-5):
            found = f"sample {row} has {loss[row].item():.4g} in the batch, {alone.item():.4g} alone"
            raise _breach(losses, "losses that do not depend on the other samples", found, "action_loss()")
    whole = policy.action_loss(dataclasses.replace(batch, valid=torch.ones_like(batch.valid)))
    if whole[0].equal(loss[0]):
        expected = "the mean over the steps where `valid` is 1"
        raise _breach(losses, expected, "a loss that does not depend on `valid`", "action_loss()")


def gradients(subject: Subject) -> None:
    """The mean of the losses has a finite gradient."""
    policy = subject.build()
    loss = policy.action_loss(subject.batch).mean()
    if not loss.requires_grad:
        raise _breach(gradients, "losses with a gradient", "detached ones", "action_loss()")
    torch.autograd.backward(loss)
    found = [parameter.grad for parameter in policy.parameters() if parameter.grad is not None]
    if not any(bool(gradient.abs().sum() > 0) for gradient in found):
        raise _breach(gradients, "a gradient in the parameters", "none that is not 0", "action_loss()")
    if not all(bool(torch.isfinite(gradient).all()) for gradient in found):
        raise _breach(gradients, "finite gradients", "some that are not", "action_loss()")


def actions(subject: Subject) -> None:
    """`act` and `predict` return chunks that depend on their arguments and on the weights alone."""
    policy, batch = subject.build().eval(), subject.batch
    size = (SAMPLES, subject.config.chunk, subject.config.action_size)
    before = read(GENERATORS)
    with _left_alone(actions, batch, "act()"):
        chunk = _act(policy, batch)
    _check_shape(actions, chunk, size, "act()")
    if chunk.dtype != torch.float32:
        raise _breach(actions, "actions of type float32", str(chunk.dtype), "act()")
    if not bool(torch.isfinite(chunk).all()):
        raise _breach(actions, "finite actions", "some that are not", "act()")
    with _left_alone(actions, batch, "predict()"):
        _check_shape(actions, policy.predict(batch), size, "predict()")
    again = _act(policy, batch)
    untouched = all(same(value, before[name]) for name, value in read(GENERATORS).items())
    if not (chunk.equal(again) and untouched):
        expected = "the same actions for the same arguments: `noise` is the only source of chance"
        raise _breach(actions, expected, "other actions, or draws from a global generator", "act()")
    if chunk.requires_grad:
        raise _breach(actions, "no gradient: use @torch.inference_mode()", "a tensor with one", "act()")
    for row in range(SAMPLES):
        alone = _act(policy, batch[row : row + 1])
        if not torch.allclose(alone, chunk[row : row + 1], rtol=1e-3, atol=1e-3):
            found = f"sample {row} gets other actions alone"
            raise _breach(actions, "actions that do not depend on the other samples", found, "act()")


def learning(subject: Subject) -> None:
    """The policy learns the toy's demonstrations, reads all that it sees, and acts in the world's units."""
    policy, source = subject.build(), toy_source("left", "up", seed=1)
    batch = subject.seen(toy_source("left", "up", seed=2).sample(200))
    before = float(policy.action_loss(batch).detach().mean())
    policy.train()
    optimise(
        policy.parameters(),
        2e-3,
        LEARNING_STEPS,
        lambda _: policy.action_loss(subject.seen(source.sample(source.batch_size))).mean(),
    )
    policy.eval()
    after = float(policy.action_loss(batch).detach().mean())
    if not after <= (1 - LEAST_FALL) * before:
        expected = f"a loss of at most {(1 - LEAST_FALL) * before:.3g} after {LEARNING_STEPS} steps"
        raise _breach(learning, expected, f"{after:.3g}, with {before:.3g} before", "action_loss()")
    words = toy_source("left").sample(SAMPLES).words, toy_source("up").sample(SAMPLES).words
    seen = batch[:SAMPLES]
    left, up = (_act(policy, dataclasses.replace(seen, words=told)).mean(dim=(0, 1)) for told in words)
    if not (left[0] < up[0] and left[1] < up[1]):
        found = f"mean actions {left.tolist()} for `go left` and {up.tolist()} for `go up`"
        raise _breach(learning, "actions that follow the instruction", found, "act()")
    chunk = _act(policy, batch)
    distance = float((chunk - batch.action).abs().mean())
    if distance > FARTHEST:
        expected = (
            f"actions in the units of the world, on average within {FARTHEST:g} of the demonstrated ones"
        )
        raise _breach(learning, expected, f"{distance:.3g}", "act()")
    normalised = (batch.action - policy.action_mean) / policy.action_std
    if (chunk - normalised).abs().mean() < distance:
        expected = "actions in the units of the world: action_mean + action_std * the normalised ones"
        raise _breach(learning, expected, "actions nearer to the normalised ones", "act()")
    chunk = _act(policy, seen)
    if _act(policy, dataclasses.replace(seen, state=seen.state.flip(0))).equal(chunk):
        raise _breach(learning, "actions that depend on the state", "the same ones in other states", "act()")
    sees = subject.config.image_size > 0
    if sees and _act(policy, dataclasses.replace(seen, image=seen.image.flip(0))).equal(chunk):
        found = "the same ones for other pictures"
        raise _breach(learning, "actions that depend on the picture", found, "act()")


def checkpoints(subject: Subject) -> None:
    """Weights and normalisation are all that a checkpoint must hold, also after some training."""
    policy, batch = subject.build(3), subject.batch
    policy.train()
    optimise(policy.parameters(), 2e-3, 4, lambda _: policy.action_loss(batch).mean())
    policy.eval()
    with tempfile.TemporaryDirectory() as folder:
        save_policy(policy, Path(folder))
        loaded = load_policy(Path(folder), name=subject.config.kind).eval()
    for name, other in (("loaded", loaded), ("copied", copy.deepcopy(policy))):
        if not _act(other, batch).equal(_act(policy, batch)):
            expected = "all that `act` needs in parameters and buffers"
            raise _breach(checkpoints, expected, f"a {name} policy acts otherwise", "register_buffer()")


def abilities(subject: Subject) -> None:
    """The policy has the abilities that it declares."""
    policy, batch = subject.build(), subject.batch
    if not isinstance(subject.cls.abilities, frozenset | set):
        expected = f'a set of texts, such as abilities = frozenset({{"{ABILITIES[0]}"}})'
        raise _breach(abilities, expected, repr(subject.cls.abilities), "abilities")
    unknown = sorted(subject.cls.abilities - set(ABILITIES))
    if unknown:
        expected = f"abilities among {', '.join(ABILITIES)}"
        raise _breach(abilities, expected, ", ".join(unknown), "abilities")
    if "hidden_states" in subject.cls.abilities:
        _check_hidden_states(policy, batch)
    if "answers" in subject.cls.abilities:
        _check_answers(policy, subject)


def _check_hidden_states(policy: Policy, batch: Batch) -> None:
    """The hidden states are what the head reads."""
    hidden, mask = policy.hidden_states(batch.state, batch.words, batch.image), policy.token_mask(batch.words)
    _check_shape(abilities, mask, (SAMPLES, 1, 1, hidden[0].shape[1]), "token_mask()")
    if len(hidden) != len(policy.backbone_layers):
        found = f"{len(hidden)} hidden states, {len(policy.backbone_layers)} layers"
        raise _breach(abilities, "one hidden state per layer of the backbone", found, "backbone_layers")
    if not torch.allclose(policy.action_loss(batch, hidden), policy.action_loss(batch), rtol=1e-4):
        expected = "the same loss with the hidden states handed over"
        raise _breach(abilities, expected, "another loss", "action_loss(batch, hidden)")
    ours = {id(parameter) for parameter in policy.head.parameters()}
    if not ours or not ours <= {id(parameter) for parameter in policy.parameters()}:
        raise _breach(abilities, "an action head with parameters of the policy", "none", "head")
    torch.autograd.backward(policy.action_loss(batch, [state.detach() for state in hidden]).mean())
    others = [parameter for parameter in policy.parameters() if id(parameter) not in ours]
    if any(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in others):
        found = "detached hidden states leave a gradient outside of it"
        raise _breach(abilities, "a gradient in the head alone", found, "action_loss(batch, hidden)")


def _check_answers(policy: Policy, subject: Subject) -> None:
    """The policy answers questions with a word of its vocabulary."""
    questions = subject.seen(toy_questions().sample(SAMPLES))
    logits = policy.answer_logits(questions.state, questions.words, questions.image)
    _check_shape(abilities, logits, (SAMPLES, policy.config.vocabulary_size), "answer_logits()")
    loss = policy.answer_loss(questions)
    if not torch.allclose(loss, F.cross_entropy(logits, questions.answer, reduction="none"), rtol=1e-4):
        raise _breach(abilities, "the cross-entropy of each right answer", "another loss", "answer_loss()")


CLAUSES = (initial_weights, losses, gradients, actions, learning, checkpoints, abilities)
"""The clauses of the contract, in the order of the checks."""


def _breach(clause: Callable[[Subject], None], expected: str, found: str, look: str) -> ContractError:
    name = clause.__name__.replace("_", " ")
    return ContractError(name, expected, found, look, subject="policy", page=PAGE)


def _stripes(state: Tensor, size: int) -> Tensor:
    """Return pictures (B, N, N, 3): each number of the states (B, S) sets the brightness of a stripe."""
    stripe = torch.arange(size) * state.shape[1] // size
    grey = (255 * torch.sigmoid(state)).to(torch.uint8)[:, stripe]
    return grey[:, None, :, None].repeat(1, size, 1, 3)


def _act(policy: Policy, batch: Batch) -> Tensor:
    """Return the actions (B, H, A) of a policy, asked as every run asks for them."""
    return policy.act(batch.state, batch.words, batch.noise, batch.image)


@contextmanager
def _left_alone(clause: Callable[[Subject], None], batch: Batch, look: str) -> Iterator[None]:
    """Check that the code inside changes no tensor of a batch: a method may use it again."""
    kept = copy.deepcopy(batch)
    yield
    for name, before in vars(kept).items():
        if not same(getattr(batch, name), before):
            raise _breach(clause, "its arguments to stay as they are", f"it changed {name} in place", look)


def _check_shape(clause: Callable[[Subject], None], value: object, shape: tuple[int, ...], look: str) -> None:
    found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
    if found != shape:
        raise _breach(clause, f"a tensor of shape {shape}", str(found), look)


def _equal(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return one.keys() == other.keys() and all(value.equal(other[name]) for name, value in one.items())
