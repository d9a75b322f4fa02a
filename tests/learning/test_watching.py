"""Methods that watch the pretraining: what they see, what they may not do, and what it costs."""

import importlib
import json
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import TINY

import clbench
from clbench.base.cache import cache_folder
from clbench.base.progress import no_progress
from clbench.learning.method_state import StateError
from clbench.learning.optimise import MethodError
from clbench.learning.pretraining import pretrain
from clbench.learning.trainer import Trainer
from clbench.learning.watching import watch, watches
from clbench.policy.transformer import TransformerPolicy
from clbench.testing import ContractError, check_method
from clbench.testing.small import SMALL

ID = f"tiny:{TINY.id}"
"""Processes that do the runs import the module of the scenario."""

METHOD = """
from dataclasses import dataclass

from clbench import Method, Uses


@dataclass
class Watching(Method):
    uses = Uses(demonstrations="prepare")

    def __post_init__(self):
        self.seen = {}

    def watch_pretraining(self, policy, progress):
        gradients = [one.grad for one in policy.parameters()]
        with_one = sum(one is not None for one in gradients)
        self.seen = {"step": progress.step, "steps": progress.steps, "calls": self.seen.get("calls", 0) + 1}
        self.seen["gradients"] = with_one / len(gradients)

    def state(self):
        return self.seen

    def load_state(self, policy, state):
        self.seen = state
"""


@dataclass
class Careful(clbench.Method):
    """Looks at the weights after the pretraining."""

    uses = clbench.Uses(demonstrations="prepare")

    def watch_pretraining(self, policy: clbench.Policy, progress: clbench.Progress) -> None:
        self.largest = max(float(one.detach().abs().max()) for one in policy.parameters())

    def state(self) -> dict[str, Any]:
        return {"largest": self.largest}

    def load_state(self, policy: clbench.Policy, state: dict[str, Any]) -> None:
        self.largest = state["largest"]


@dataclass
class Scaled(Careful):
    """Multiplies what it sees."""

    scale: float = 1.0

    def state(self) -> dict[str, Any]:
        return {"largest": self.scale * self.largest}


@dataclass
class Listing(Careful):
    """Returns a list in its state."""

    def state(self) -> dict[str, Any]:
        return {"largest": [self.largest]}


@dataclass
class Drawing(Careful):
    """Draws a number when it gets its state."""

    def load_state(self, policy: clbench.Policy, state: dict[str, Any]) -> None:
        self.drawn = float(torch.rand(()))


@dataclass
class Meddling(Careful):
    """Changes a weight on the way."""

    def watch_pretraining(self, policy: clbench.Policy, progress: clbench.Progress) -> None:
        super().watch_pretraining(policy, progress)
        if progress.step == 2:
            next(policy.head.parameters()).data.mul_(1.5)


@dataclass
class Undeclared(Careful):
    """Declares no demonstrations."""

    uses = clbench.Uses()


@pytest.mark.long
def test_a_method_sees_every_step_and_pays_for_it(
    tmp_path: Path, empty_caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "watching_method.py").write_text(METHOD, encoding="utf-8")
    method = importlib.import_module("watching_method").Watching
    (first,) = clbench.run(ID, method, seeds=1, records=tmp_path / "one")
    (second,) = clbench.run(ID, method, seeds=1, records=tmp_path / "two")
    steps = TINY.budget.pretraining_steps
    assert first.costs.preparation_steps == second.costs.preparation_steps == steps
    assert first.episodes == second.episodes  # the second one had it from the cache
    (state,) = (cache_folder() / "watched").glob("*/method.json")
    seen = {"step": steps, "steps": steps, "calls": steps + 1, "gradients": 1.0}
    assert json.loads(state.read_text(encoding="utf-8")) == seen


def test_a_draw_after_the_pretraining_repeats_itself_and_moves_no_other() -> None:
    drawn = set()
    for seed in (1, 2):
        torch.manual_seed(seed)
        before = torch.get_rng_state()
        trainer = Trainer.open(TINY, Drawing, 0, "cpu")
        trainer.prepare()
        assert torch.get_rng_state().equal(before)
        drawn.add(trainer.method.drawn)  # type: ignore[attr-defined]
    assert len(drawn) == 1


def test_the_pretraining_that_is_watched_is_that_of_the_policy_and_not_of_the_run() -> None:
    opened = Trainer.open(TINY, Careful, 0, "cpu")
    trainer = Trainer(TINY, opened.data, opened.pretrained, Careful, seed=3, pretraining_seed=0)
    assert trainer.prepare() == TINY.budget.pretraining_steps


@pytest.mark.usefixtures("empty_caches")
def test_a_pretraining_from_the_cache_counts_as_many_steps_as_a_watched_one() -> None:
    pretrained = pretrain(TINY, 0, no_progress)
    for _ in range(2):
        steps: list[float] = []
        watch(Careful(), pretrained, TINY, 0, nullcontext, steps.append)
        assert sum(steps) == TINY.budget.pretraining_steps
    with torch.no_grad():
        next(pretrained.parameters()).add_(1.0)
    with pytest.raises(MethodError, match=r"watch_pretraining\(\) must change nothing, but .* differs"):
        watch(Careful(), pretrained, TINY, 0, nullcontext, no_progress)  # not from the cache of other weights


@pytest.mark.usefixtures("empty_caches")
def test_each_setting_of_a_method_has_a_state_of_its_own() -> None:
    pretrained = pretrain(TINY, 0, no_progress)
    one, two = (
        watch(Scaled(scale=scale), pretrained, TINY, 0, nullcontext, no_progress)["largest"]
        for scale in (1.0, 2.0)
    )
    assert two == 2 * one  # type: ignore[operator]


@pytest.mark.usefixtures("empty_caches")
def test_a_state_that_no_file_can_hold_is_refused_after_the_pretraining() -> None:
    pretrained = pretrain(TINY, 0, no_progress)
    with pytest.raises(StateError, match=r"state\(\) must return a flat dictionary"):
        watch(Listing(), pretrained, TINY, 0, nullcontext, no_progress)


def test_only_a_method_that_overrides_the_hook_watches() -> None:
    assert watches(Careful)
    assert not watches(clbench.load_method("sft"))


class Downloaded(TransformerPolicy):
    """A new one has pretrained weights of its own."""

    pretrained = True


def test_there_is_nothing_to_watch_where_a_policy_has_pretrained_weights_of_its_own() -> None:
    with pytest.raises(MethodError, match="nothing to watch: Downloaded has pretrained weights of its own"):
        watch(Careful(), Downloaded(SMALL), TINY, 0, nullcontext, no_progress)


@pytest.mark.slow
def test_a_method_that_only_looks_keeps_the_contract() -> None:
    check_method(Careful)


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "message", "look"),
    [
        (Meddling, r"watch_pretraining\(\) must change nothing, but .* differs", "watch_pretraining()"),
        (Undeclared, r"declare `uses = Uses\(demonstrations=\"prepare\"\)`", "uses"),
    ],
)
def test_a_method_that_meddles_or_does_not_declare_its_data_is_refused(
    method: type[clbench.Method], message: str, look: str
) -> None:
    with pytest.raises(ContractError, match=message) as caught:
        check_method(method)
    assert caught.value.look == look
