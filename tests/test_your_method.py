"""The worked examples of `docs/guide/your_method.md`, run unchanged, as a stranger would."""

import copy
import dataclasses
import importlib
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import clbench
from clbench.learning.method import Method, Progress, Stage
from clbench.learning.prior import Nothing, Prior, Source
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.testing import TOY, check_method
from clbench.testing.small import SMALL, toy_source
from clbench.testing.toy_run import ToyRun

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "your_method.md"

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the Python of the page; its methods can be imported under the names that it gives them."""
    found = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    monkeypatch.syspath_prepend(tmp_path)
    names = {"der": 0, "si": 2, "prompt": 4, "teacher": 5}
    files = {name: found[number] for name, number in names.items()} | {"recipes": "\n".join(found[6:])}
    for name, text in files.items():
        (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
        monkeypatch.delitem(sys.modules, name, raising=False)
    return found


@pytest.fixture
def der(blocks: list[str]) -> Any:
    """Return the method of the page."""
    return importlib.import_module("der").DER(kept=8)


def recipe(name: str) -> Any:
    """Return a method of the recipes, with what they leave out."""
    cls = getattr(importlib.import_module("recipes"), name)
    cls.__doc__ = "A recipe."
    return dataclasses.dataclass(cls)


@dataclasses.dataclass
class Visits(Method):
    """Keeps the states that its policy visits."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        self.seen = torch.tensor(np.stack(sys.modules["recipes"].visited(policy, stage)))

    def diagnostics(self) -> dict[str, Any]:
        return {"seen": self.seen.tolist()} if hasattr(self, "seen") else {}


@pytest.mark.long
@pytest.mark.parametrize("name", ["EMA", "SAM", "Calm"])
@pytest.mark.usefixtures("blocks")
def test_its_recipes_keep_the_contract(name: str) -> None:
    check_method(recipe(name))


@pytest.mark.long
@pytest.mark.usefixtures("blocks")
def test_its_recipe_for_episodes_returns_the_states_of_one_and_keeps_the_contract() -> None:
    importlib.import_module("recipes")
    check_method(Visits)
    run = ToyRun(Visits, targets=1, steps=2)
    seen = run.outcomes["stage 1 (right)", "diagnostics"]["seen"]
    assert 2 <= len(seen) <= TOY.task("right").horizon
    assert all(len(state) == 4 for state in seen)
    moved = np.abs(np.diff(np.array(seen), axis=0)[:, :2]).max(axis=1)
    assert np.all((moved > 0) & (moved < 0.21))


@pytest.mark.usefixtures("blocks")
def test_its_average_follows_the_weights_and_is_in_the_policy_at_the_end() -> None:
    method, policy, source = recipe("EMA")(), TransformerPolicy(SMALL), toy_source("right")
    stage = Stage(1, TOY.task("right"), 0, 10, source, Prior({}))
    begun = flat(method.start_task(policy, stage))
    method.loss(policy, source.sample(4), Progress(0, 10))
    with torch.no_grad():
        for one in policy.parameters():
            one.add_(1.0)
    method.end_task(policy, stage)
    np.testing.assert_allclose(flat(policy.parameters()), begun + 0.01, atol=1e-5)


@pytest.mark.usefixtures("blocks")
def test_its_second_pass_has_the_gradient_at_the_worst_weights_and_returns_to_the_weights() -> None:
    method, policy, batch = recipe("SAM")(), TransformerPolicy(SMALL), toy_source("right").sample(8)
    before = flat(policy.parameters())
    method.gradients(policy, method.loss(policy, batch, Progress(0, 10)))
    assert np.array_equal(flat(policy.parameters()), before)
    twin = TransformerPolicy(SMALL)
    weights = list(twin.parameters())
    slopes = torch.autograd.grad(twin.action_loss(batch).mean(), weights, materialize_grads=True)
    length = float(np.linalg.norm(flat(slopes)))
    with torch.no_grad():
        for one, slope in zip(weights, slopes, strict=True):
            one.add_(0.05 * slope / length)
    torch.autograd.backward(twin.action_loss(batch).mean())
    ours, theirs = (
        flat([one.grad for one in model.parameters() if one.grad is not None]) for model in (policy, twin)
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-6)
    assert not np.allclose(ours, flat([one for one in slopes if one.any()]), rtol=1e-3, atol=1e-6)


@pytest.mark.usefixtures("blocks")
def test_its_act_halves_the_noise_where_all_words_are_known() -> None:
    method, policy = recipe("Calm")(), TransformerPolicy(SMALL)
    method.prepare(policy, Prior({}))
    method.start_task(policy, Stage(1, TOY.task("right"), 0, 10, toy_source("right"), Prior({})))
    plain = TransformerPolicy(SMALL)
    for task, factor in (("right", 0.5), ("left", 1.0)):
        batch = toy_source(task).sample(4)
        expected = plain.act(batch.state, batch.words, factor * batch.noise)
        assert policy.act(batch.state, batch.words, batch.noise).equal(expected)


@pytest.mark.long
@pytest.mark.parametrize("block", [1, 3])
def test_its_methods_keep_the_contract(block: int, blocks: list[str]) -> None:
    exec(blocks[block], {})


@pytest.mark.long
@pytest.mark.parametrize(("module", "name"), [("prompt", "Prompt"), ("teacher", "Teacher")])
@pytest.mark.usefixtures("blocks")
def test_its_shorter_methods_keep_the_contract_too(module: str, name: str) -> None:
    check_method(getattr(importlib.import_module(module), name))


@pytest.mark.usefixtures("blocks")
def test_its_prompt_acts_in_the_policy_and_in_copies_of_it() -> None:
    method, policy = importlib.import_module("prompt").Prompt(), TransformerPolicy(SMALL)
    batch = toy_source("right").sample(4)

    def act(policy: Any) -> torch.Tensor:
        return policy.act(batch.state, batch.words, batch.noise, batch.image)  # type: ignore[no-any-return]

    plain = act(policy)
    method.prepare(policy, Prior({}))
    assert act(policy).equal(plain)
    twin: Any = copy.deepcopy(policy)
    with torch.no_grad():
        twin.backbone_layers[0].prompt.fill_(1.0)
    assert act(policy).equal(plain)
    assert not act(twin).equal(plain)


@pytest.mark.usefixtures("blocks")
def test_its_teacher_follows_the_policy_to_its_device() -> None:
    method, policy = importlib.import_module("teacher").Teacher(), TransformerPolicy(SMALL)
    method.load_state(policy, policy.state_dict())
    stage = Stage(1, TOY.task("right"), 0, 10, toy_source("right"), Prior({}))
    method.start_task(policy.to("meta"), stage)
    assert method.teacher.device.type == "meta"


def test_its_loss_is_that_of_der_plus_plus(der: Any) -> None:
    policy, later = TransformerPolicy(SMALL), TransformerPolicy(SMALL, seed=1)
    der.prepare(policy, Prior({"demonstrations": toy_source("left", "up")}))
    new, (old, velocity), replayed = der.batch(toy_source("right"), Prior({}))
    torch.manual_seed(3)
    loss = der.loss(later, (new, (old, velocity), replayed), Progress(0, 10)).item()
    torch.manual_seed(3)
    fresh = vars(replayed) | {
        "draw": torch.rand_like(replayed.draw),
        "noise": torch.randn_like(replayed.noise),
    }
    with torch.no_grad():
        now, then = (one.predict(old).numpy() for one in (later, policy))
        plain = [later.action_loss(batch).numpy().mean() for batch in (new, type(new)(**fresh))]
    errors = ((now - then) ** 2)[old.valid.numpy() > 0]
    assert loss == pytest.approx(plain[0] + 1.0 * errors.mean() + 0.5 * plain[1], rel=1e-5)
    assert np.all(errors > 0)


def test_its_method_begins_without_skills_and_remembers_from_the_first_target_on(der: Any) -> None:
    nothing: Any = Nothing()
    policy, generator = TransformerPolicy(SMALL), torch.Generator()
    der.prepare(policy, Prior({"demonstrations": Source(nothing, generator, 8)}))
    assert der.state() == {}
    der.load_state(policy, {})
    source = toy_source("right")
    new, *rest = der.batch(source, Prior({}))
    assert rest == [None, None]
    loss = der.loss(policy, (new, None, None), Progress(0, 10))
    assert loss.item() == policy.action_loss(new).mean().item()
    der.end_task(policy, Stage(1, TOY.task("right"), 0, 10, source, Prior({})))
    assert len(der.memory) == len(der.velocity) == 8


def flat(tensors: Iterable[torch.Tensor]) -> Any:
    return np.concatenate([one.detach().double().numpy().ravel() for one in tensors])


def test_the_importance_of_the_skills_is_that_of_synaptic_intelligence(blocks: list[str]) -> None:
    si = importlib.import_module("si").SI()
    policy = TransformerPolicy(SMALL)
    parameters = list(policy.parameters())
    source = toy_source("left", "up")
    optimiser = torch.optim.SGD(parameters, lr=0.1)
    weights, gradients = [flat(parameters)], []
    si.watch_pretraining(policy, Progress(0, 3))
    for step in range(3):
        optimiser.zero_grad(set_to_none=False)
        torch.autograd.backward(policy.action_loss(source.sample(8)).mean())
        optimiser.step()
        si.watch_pretraining(policy, Progress(step + 1, 3))
        weights.append(flat(parameters))
        gradients.append(flat([torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]))
    steps = zip(gradients, weights[:-1], weights[1:], strict=True)
    path = -sum(gradient * (after - before) for gradient, before, after in steps)
    expected = np.maximum(path, 0) / ((weights[-1] - weights[0]) ** 2 + 1e-3)
    assert np.any(expected > 1e-6)
    np.testing.assert_allclose(si.state()["importance"].numpy(), expected, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(si.state()["anchor"].numpy(), weights[-1], rtol=1e-6)


@pytest.mark.slow  # 5 s: it pretrains and runs two methods
def test_synaptic_intelligence_watches_the_pretraining_and_keeps_more_skills_than_fine_tuning(
    blocks: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    toy, strong = "clbench.testing:clbench/Toy-v0", {"strength": 1e4}
    (plain,) = clbench.run(toy, "sft", seeds=1, records=tmp_path / "records")
    (held,) = clbench.run(toy, "si:SI", seeds=1, settings=strong, records=tmp_path / "records")
    assert held.costs.preparation_steps == TOY.budget.pretraining_steps
    assert held.costs.bytes_kept == 2 * 4 * (held.costs.parameters or 0)
    retained = [one.matrix()["retained"].iloc[-1].mean() for one in (plain, held)]
    assert retained[1] > retained[0] + 0.5


@pytest.mark.slow
def test_the_default_of_synaptic_intelligence_protects_skills_and_learns(
    blocks: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    toy = "clbench.testing.fetch_toy:clbench/FetchToy-v0"
    plain, held = (
        clbench.run(toy, method, seeds=1, records=tmp_path / "records")[0].matrix().iloc[-1]
        for method in ("sft", "si:SI")
    )
    assert plain["retained"].mean() <= 0.2
    assert held["retained"].mean() >= 0.5
    assert held["target"].mean() >= 0.3
