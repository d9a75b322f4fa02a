"""Each broken policy breaks one clause of the contract, and the check names it."""

from dataclasses import dataclass

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from clbench.base.errors import InputError, UnknownNameError, WrongTypeError
from clbench.learning.method import Method
from clbench.learning.registry import load_method
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.kinds import check_abilities
from clbench.policy.policy import MissingAbilityError, Policy, PolicyConfig
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.policies import POLICIES
from clbench.testing import ContractError, check_method, check_policy, policy_checks
from clbench.testing.policy_contract import CLAUSES


@pytest.mark.long
@pytest.mark.parametrize("kind", POLICIES)
def test_the_built_in_policies_keep_the_contract(kind: str) -> None:
    assert [str(check) for check in policy_checks(kind)] == [clause.__name__ for clause in CLAUSES]
    check_policy(kind)


@pytest.mark.long
@pytest.mark.parametrize("kind", POLICIES)
def test_the_built_in_policies_keep_the_contract_with_pictures(kind: str) -> None:
    check_policy(kind, image_size=32)


class Base(TransformerPolicy):
    """A policy that keeps the contract; those below break one clause each."""


class Plain(Policy):
    """A small policy without any ability: a linear map of state and words."""

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__(config, seed)
        size = config.state_size + 32
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.words = torch.nn.Embedding(config.vocabulary_size, 32)
            self.out = torch.nn.Linear(size, config.chunk * config.action_size)

    def chunk(self, state: Tensor, words: Tensor) -> Tensor:
        seen = torch.cat([(state - self.state_mean) / self.state_std, self.words(words).mean(1)], dim=1)
        return self.out(seen).view(len(state), self.config.chunk, -1)  # type: ignore[no-any-return]

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        error = (self.predict(batch) - batch.action).square().mean(dim=2)
        return (error * batch.valid).sum(dim=1) / batch.valid.sum(dim=1)

    def predict(self, batch: Batch) -> Tensor:
        return self.chunk(batch.state, batch.words)

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return self.chunk(state, words)


def test_a_policy_without_abilities_keeps_the_contract_and_says_what_it_lacks() -> None:
    check_policy(f"{__name__}:Plain")
    policy = Plain(PolicyConfig(4, 2))
    with pytest.raises(MissingAbilityError, match="Plain does not have the ability 'hidden_states'"):
        policy.hidden_states(torch.zeros(1, 4), torch.zeros(1, 12, dtype=torch.long))
    with pytest.raises(MissingAbilityError, match="'answers'"):
        policy.answer_logits(torch.zeros(1, 4), torch.zeros(1, 12, dtype=torch.long))
    assert policy.vision_to_pretrain() is None


class Careless(Base):
    """Draws its weights from the global generator."""

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__(config, seed)
        self.extra = torch.nn.Parameter(torch.rand(3))


class Constant(Base):
    """Has the same weights for every seed."""

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__(config, 0)


class Downloaded(Constant):
    """Has pretrained weights of its own, the same for every seed."""

    pretrained = True


@pytest.mark.long
def test_pretrained_weights_of_a_policys_own_may_be_the_same_for_all_seeds() -> None:
    check_policy(f"{__name__}:Downloaded")


class Together(Base):
    """Has one loss for all samples."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        return super().action_loss(batch, hidden).mean()


class Drawing(Base):
    """Draws in its loss."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        loss = super().action_loss(batch, hidden)
        return loss * (1 + torch.rand_like(loss))


class Dropping(Plain):
    """Has dropout, which its evaluation leaves out."""

    def chunk(self, state: Tensor, words: Tensor) -> Tensor:
        return F.dropout(super().chunk(state, words), training=self.training)


class Normalising(Base):
    """Divides the losses by their mean."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        loss = super().action_loss(batch, hidden)
        return loss / loss.mean()


class Padded(Base):
    """Counts steps after the end of an episode."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        whole = Batch(**{**vars(batch), "valid": torch.ones_like(batch.valid)})
        return super().action_loss(whole, hidden)


class Detached(Base):
    """Has a loss without a gradient."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        loss = super().action_loss(batch, hidden)
        return loss.detach() + 0 * loss


class Cut(Base):
    """Has a loss that no weight enters any more."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        return super().action_loss(batch, hidden).detach()


class Meddling(Base):
    """Changes the actions that it learns from; a second time they stay."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        batch.action.clamp_(-0.1, 0.1)
        return super().action_loss(batch, hidden)


class Shifting(Base):
    """Changes the state that it acts on."""

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return super().act(state.sub_(1.0), words, noise, image)


class Rounded(Base):
    """Acts with half the digits."""

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return super().act(state, words, noise, image).bfloat16()


class Diverged(Base):
    """Acts with numbers that are none."""

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return super().act(state, words, noise, image) * float("nan")


class Listing(Plain):
    """Lists its abilities."""

    abilities = ("answers",)  # type: ignore[assignment]


class Restless(Base):
    """Acts at random."""

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return super().act(state, words, torch.randn_like(noise), image)


class Short(Base):
    """Returns the actions that are executed."""

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return super().act(state, words, noise, image)[:, : self.config.executed]


class Deaf(Base):
    """Does not read the words."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        return super().action_loss(Batch(**{**vars(batch), "words": torch.ones_like(batch.words)}), hidden)

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return super().act(state, torch.ones_like(words), noise, image)


class Stubborn(Base):
    """Does not learn."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        loss = super().action_loss(batch, hidden)
        return loss.detach() + 1e-12 * loss


class Forgetful(Base):
    """Keeps the scale of its actions outside of its buffers."""

    scale = 1.0

    def normalise_like(self, state: Tensor, action: Tensor | None = None) -> None:
        super().normalise_like(state, action)
        self.scale = 2.0

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return self.scale * super().act(state, words, noise, image)


class Averaging(Base):
    """Keeps a number that training changes outside of its buffers."""

    scale = 1.0

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        self.scale *= 0.999
        return super().action_loss(batch, hidden)

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return self.scale * super().act(state, words, noise, image)


class Unscaled(Base):
    """Returns normalised actions."""

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return (super().act(state, words, noise, image) - self.action_mean) / self.action_std


class Saturated(Base):
    """Returns actions in thousandths of the world's units."""

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        return 1000 * super().act(state, words, noise, image)


class Boastful(Plain):
    """Declares an ability that there is not."""

    abilities = frozenset({"telepathy"})


class Leaking(Base):
    """Reads the observation again when it is given hidden states."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        return super().action_loss(batch)


class Wrong(Base):
    """Has another loss of its answers."""

    def answer_loss(self, questions: QuestionBatch) -> Tensor:
        return 2 * super().answer_loss(questions)


class Mute(Base):
    """Answers with a vocabulary of its own."""

    def answer_logits(self, state: Tensor, words: Tensor, image: Tensor | None = None) -> Tensor:
        return F.pad(super().answer_logits(state, words, image), (0, 1))


class ImageBlind(Base):
    """Takes no picture."""

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor) -> Tensor:  # type: ignore[override] # the fault
        return super().act(state, words, noise)


class Stateless(Plain):
    """Does not read the state."""

    def chunk(self, state: Tensor, words: Tensor) -> Tensor:
        return super().chunk(0 * state + self.state_mean, words)


class Batched(Plain):
    """Normalises over the batch."""

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__(config, seed)
        self.norm = torch.nn.BatchNorm1d(config.state_size, affine=False)

    def chunk(self, state: Tensor, words: Tensor) -> Tensor:
        return super().chunk(self.norm(state), words)


BROKEN: list[tuple[type[Policy], str, str]] = [
    (Careless, "initial weights", "torch's random changed"),
    (Constant, "initial weights", "seeds 1 and 2 give the same weights"),
    (Together, "losses", r"tensor of shape \(6,\)\n  found:    \(\)"),
    (Drawing, "losses", "other losses at the second call"),
    (Dropping, "losses", "in `draw` and `noise`; no dropout"),
    (Normalising, "losses", "alone"),
    (Padded, "losses", "does not depend on `valid`"),
    (Detached, "gradients", "none that is not 0"),
    (Cut, "gradients", r"losses with a gradient\n  found:    detached ones"),
    (Restless, "actions", "draws from a global generator"),
    (Meddling, "losses", "it changed action in place"),
    (Shifting, "actions", "it changed state in place"),
    (Rounded, "actions", "torch.bfloat16"),
    (Diverged, "actions", "finite actions"),
    (Short, "actions", r"\(6, 8, 2\)\n  found:    \(6, 4, 2\)"),
    (ImageBlind, "actions", "TypeError: .*act.* takes 4 positional arguments but 5 were given"),
    (Batched, "losses", r"ValueError: Expected more than 1 value(.|\n)*look at:  chunk\(\)"),
    (Stateless, "learning", "actions that depend on the state"),
    (Deaf, "learning", "for `go left`"),
    (Stubborn, "learning", "a loss of at most"),
    (Unscaled, "learning", "actions in the units of the world"),
    (Saturated, "learning", "within 1 of the demonstrated ones"),
    (Forgetful, "checkpoints", "a loaded policy acts otherwise"),
    (Averaging, "checkpoints", "a loaded policy acts otherwise"),
    (Boastful, "abilities", "telepathy"),
    (Listing, "abilities", r"a set of texts, such as abilities = frozenset\(\{"),
    (Leaking, "abilities", "gradient outside of it"),
    (Wrong, "abilities", "another loss"),
    (Mute, "abilities", "vocabulary|shape"),
]


@pytest.mark.parametrize(("cls", "clause", "words"), BROKEN, ids=[cls.__name__ for cls, *_ in BROKEN])
def test_a_broken_policy_is_caught_by_its_clause(cls: type[Policy], clause: str, words: str) -> None:
    (check,) = [
        check
        for check in policy_checks(f"{__name__}:{cls.__name__}")
        if str(check) == clause.replace(" ", "_")
    ]
    with pytest.raises(ContractError, match=words) as caught:
        check()
    assert (caught.value.clause, caught.value.subject) == (clause, "policy")
    assert "docs/guide/your_policy.md#" in str(caught.value)


def test_a_policy_that_does_not_look_at_the_pictures_breaks_the_contract() -> None:
    (check,) = [check for check in policy_checks(f"{__name__}:Plain", 32) if str(check) == "learning"]
    with pytest.raises(ContractError, match="actions that depend on the picture"):
        check()


@pytest.mark.parametrize(
    ("kind", "error", "words"),
    [
        ("flwo", UnknownNameError, "Did you mean 'flow'"),
        ("no_such_module:Policy", UnknownNameError, "no_such_module"),
        ("clbench.policy.policy:Polic", UnknownNameError, "Did you mean 'Policy"),
        ("clbench.policy.batch:Batch", WrongTypeError, r"not a subclass of clbench\.Policy"),
    ],
)
def test_what_is_no_policy_is_refused_by_name(kind: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        check_policy(kind)


@pytest.mark.long
def test_every_broken_policy_is_one_by_its_clause_alone() -> None:
    """The class that they derive from keeps the contract: what the checks find is the change."""
    check_policy(f"{__name__}:Base")


@pytest.mark.long
def test_a_method_is_checked_on_a_policy_of_ones_own() -> None:
    check_method(load_method("sft"), policy=f"{__name__}:Plain")
    with pytest.raises(ContractError, match="Plain does not have the ability 'hidden_states'"):
        check_method(load_method("aegis"), policy=f"{__name__}:Plain")


@dataclass
class Demanding(Method):
    """Needs what no policy has."""

    needs = ("telepathy",)


def test_a_method_must_not_need_what_no_policy_has() -> None:
    with pytest.raises(ContractError, match=r"needs among hidden_states, answers\n  found:    telepathy"):
        check_method(Demanding)


def test_abilities_decide_which_methods_run() -> None:
    kind = f"{__name__}:Plain"
    for name in ("sft", "lora", "consft", "experience_replay", "l2_sp", "ewc"):
        check_abilities(kind, load_method(name).needs, name)
    with pytest.raises(
        InputError, match=r"aegis needs .* hidden_states; .*:Plain lacks hidden_states\. .*`abilities`"
    ):
        check_abilities(kind, load_method("aegis").needs, "aegis")
    with pytest.raises(InputError, match=r"lacks answers, hidden_states\."):
        check_abilities(kind, load_method("knowledge_insulation").needs, "knowledge_insulation")
