"""LoRA: the policy under its adapters, and the sum of the adapters."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import build_method
from numpy.typing import NDArray
from torch import Tensor, nn

from clbench.base.errors import InputError
from clbench.learning.adaptation import adapt
from clbench.learning.method import Progress, Stage
from clbench.learning.prior import Prior
from clbench.policy.checkpoint import load_policy, save_policy
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.budget import Budget
from clbench.testing import TOY
from clbench.testing.small import SMALL, toy_source

pytestmark = pytest.mark.usefixtures("one_thread")
MAP = "backbone.layers.1.attention.key_value"
VARIANTS = pytest.mark.parametrize("variant", ["lora", "dora", "rslora"])


def _stage() -> Stage:
    return Stage(1, TOY.task("right"), 0, 8, toy_source("right"), Prior({}))


def _weights(policy: Policy) -> dict[str, Tensor]:
    """Return the policy's weights under the names that they have without adapters."""
    return {
        name.replace(".base_layer", ""): weight.detach().clone() for name, weight in policy.named_parameters()
    }


def _adapters(policy: Policy) -> dict[str, Tensor]:
    return {name: weight for name, weight in _weights(policy).items() if "lora_" in name}


def _adapted(variant: str, **changes: Any) -> tuple[Any, Policy]:
    """Return a method and the policy after a short stage of it."""
    method, policy = (
        build_method("lora", {"variant": variant, "rank": 4, **changes}),
        TransformerPolicy(SMALL, seed=1),
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        method.prepare(policy, Prior({}))
    adapt(policy, method, _stage(), Budget(learning_rate=3e-3))
    return method, policy


@VARIANTS
def test_adapters_begin_as_no_change_and_sit_on_every_linear_map_of_the_layers(variant: str) -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right", seed=1).sample(8)
    before = policy.action_loss(batch).detach()
    build_method("lora", {"variant": variant}).prepare(policy, Prior({}))
    torch.testing.assert_close(policy.action_loss(batch).detach(), before, rtol=1e-5, atol=1e-6)
    found = {name.partition(".lora_")[0] for name in _adapters(policy)}
    maps = [f"attention.{part}" for part in ("query", "key_value", "out")] + [
        "feed_forward.1",
        "feed_forward.3",
    ]
    assert found == {
        f"{part}.layers.{layer}.{name}" for part in ("backbone", "head") for layer in (0, 1) for name in maps
    }
    assert sum(value.numel() for value in _adapters(policy).values()) > 0


@VARIANTS
def test_the_weights_under_the_adapters_never_change_and_all_adapters_train(variant: str) -> None:
    method, policy = build_method("lora", {"variant": variant}), TransformerPolicy(SMALL, seed=1)
    before = _weights(policy)
    method.prepare(policy, Prior({}))
    adapters = _adapters(policy)
    assert all(weight.equal(before[name]) for name, weight in _weights(policy).items() if name in before)
    steps = adapt(policy, method, _stage(), Budget(learning_rate=3e-3))
    after = _weights(policy)
    assert steps == 8
    assert after.keys() == before.keys() | adapters.keys()
    assert all(after[name].equal(weight) for name, weight in before.items())
    assert not any(after[name].equal(weight) for name, weight in adapters.items())
    trained = {name for name, weight in policy.named_parameters() if weight.requires_grad}
    assert trained == adapters.keys()


@VARIANTS
def test_merged_adapters_act_as_they_did(variant: str) -> None:
    from peft.tuners.lora import LoraLayer

    _, policy = _adapted(variant)
    batch = toy_source("right", seed=1).sample(8)
    start = TransformerPolicy(SMALL, seed=1).act(batch.state, batch.words, batch.noise)
    loss, actions = policy.action_loss(batch).detach(), policy.act(batch.state, batch.words, batch.noise)
    assert (actions - start).abs().max() > 1e-3
    layers = [module for module in policy.modules() if isinstance(module, LoraLayer)]
    assert len(layers) == 20
    for layer in layers:
        layer.merge()
    torch.testing.assert_close(policy.action_loss(batch).detach(), loss, rtol=0, atol=1e-5)
    torch.testing.assert_close(policy.act(batch.state, batch.words, batch.noise), actions, rtol=0, atol=1e-5)


@VARIANTS
def test_an_adapter_adds_the_papers_matrix(variant: str) -> None:
    """W + s B A with s = alpha / rank, or alpha / sqrt(rank); DoRA gives each row of it a learned norm."""
    _, policy = _adapted(variant, alpha=6.0)
    weights = {name: weight.double().numpy() for name, weight in _weights(policy).items()}
    under = weights[f"{MAP}.weight"]
    down, up = (weights[f"{MAP}.lora_{part}.default.weight"] for part in "AB")
    assert (down.shape, up.shape) == ((4, 32), (64, 4))
    expected = under + 6.0 / (math.sqrt(4) if variant == "rslora" else 4) * up @ down
    if variant == "dora":
        norms = weights[f"{MAP}.lora_magnitude_vector.default.weight"]
        expected = norms[:, None] * expected / np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(_map(policy), expected, rtol=1e-4, atol=1e-5)
    assert np.abs(expected - under).max() > 1e-3


@pytest.mark.parametrize("rank", [4, 16, 64])
def test_each_adapter_has_the_rank_that_is_asked_for(rank: int) -> None:
    policy = TransformerPolicy(SMALL)
    maps = {name: module for name, module in policy.named_modules() if isinstance(module, nn.Linear)}
    build_method("lora", {"rank": rank}).prepare(policy, Prior({}))
    found = {name: tuple(weight.shape) for name, weight in _adapters(policy).items()}
    expected = {}
    for name, module in maps.items():
        if "layers" in name.split("."):
            expected[f"{name}.lora_A.default.weight"] = (rank, module.in_features)
            expected[f"{name}.lora_B.default.weight"] = (module.out_features, rank)
    assert found == expected


@VARIANTS
def test_the_second_target_goes_on_with_the_adapters_of_the_first(variant: str) -> None:
    method, policy = _adapted(variant)
    batch = toy_source("right", seed=1).sample(8)
    before, actions = _weights(policy), policy.act(batch.state, batch.words, batch.noise)
    method.start_task(policy, Stage(2, TOY.task("down"), 1, 8, toy_source("down"), Prior({})))
    assert policy.act(batch.state, batch.words, batch.noise).equal(actions)
    assert _weights(policy).keys() == before.keys()
    assert all(weight.equal(before[name]) for name, weight in _weights(policy).items())


def _map(policy: Policy) -> NDArray[np.float64]:
    """Return the matrix of a linear map with its adapter, from the images of unit vectors."""
    module: Any = policy.get_submodule(MAP)
    with torch.no_grad():
        units = module(torch.eye(32)[None])[0] - module(torch.zeros(1, 1, 32))[0]
    return np.asarray(units.T.double().numpy())


@pytest.mark.long
@VARIANTS
def test_an_adapted_policy_survives_saving_and_goes_on_as_it_would_have(variant: str, tmp_path: Path) -> None:
    method, policy = _adapted(variant)
    save_policy(policy, tmp_path)
    other: Any = build_method("lora", {"variant": variant, "rank": 4})
    loaded = load_policy(tmp_path, lambda plain: other.load_state(plain, method.state()))
    batch = toy_source("right", seed=1).sample(8)
    assert loaded.action_loss(batch).equal(policy.action_loss(batch))
    assert loaded.act(batch.state, batch.words, batch.noise).equal(
        policy.act(batch.state, batch.words, batch.noise)
    )
    for each, trained in ((method, policy), (other, loaded)):
        adapt(trained, each, _stage(), Budget(learning_rate=3e-3))
    assert _weights(policy).keys() == _weights(loaded).keys()
    assert all(weight.equal(_weights(loaded)[name]) for name, weight in _weights(policy).items())


def test_the_learning_rate_of_the_adapters_is_a_multiple_of_the_scheduled_one() -> None:
    method = build_method("lora", {"speed": 2.5})
    assert method.learning_rate(0.01, Progress(3, 10)) == pytest.approx(0.025)


def test_the_step_factor_and_the_speed_each_multiply_the_learning_rate_once() -> None:
    method, policy = build_method("lora", {"speed": 2.5, "step_factor": 0.1}), TransformerPolicy(SMALL)
    method.prepare(policy, Prior({}))
    rates: list[float | None] = []
    stage = Stage(1, TOY.task("right"), 0, 1, toy_source("right"), Prior({}))  # one step, at the peak
    adapt(policy, method, stage, Budget(learning_rate=1e-3), lambda step: rates.append(step.learning_rate))
    assert rates == pytest.approx([2.5e-4])


class _Flat(nn.Module):
    """A policy of a stranger, as far as adapters look at it."""

    def __init__(self) -> None:
        super().__init__()
        self.map = nn.Linear(4, 2)


def test_a_policy_without_layers_is_refused_with_what_to_do() -> None:
    method: Any = build_method("lora", {})
    with pytest.raises(InputError, match=r"called `layers`; _Flat has none\. Rename one, or leave lora out"):
        method.prepare(_Flat(), Prior({}))


class _Sublayers(TransformerPolicy):
    """A policy with a linear map in a module whose name only contains the word `layers`."""

    def __init__(self) -> None:
        super().__init__(SMALL)
        self.sublayers = nn.ModuleList([nn.Linear(8, 8)])


def test_a_module_whose_name_only_contains_the_word_layers_has_no_adapter() -> None:
    policy = _Sublayers()
    build_method("lora", {}).prepare(policy, Prior({}))
    adapted = {name.partition(".")[0] for name in _adapters(policy)}
    assert adapted == {"backbone", "head"}


class _Fused(TransformerPolicy):
    """A policy with PyTorch's own layers, which read the weights of their linear maps themselves."""

    def __init__(self, layer: nn.Module) -> None:
        super().__init__(SMALL)
        self.encoder = nn.ModuleDict({"layers": nn.ModuleList([layer])})


@pytest.mark.parametrize(
    ("layer", "place"),
    [
        (nn.TransformerEncoderLayer(8, 2), r"encoder\.layers\.0\.self_attn\.out_proj: MultiheadAttention"),
        (nn.MultiheadAttention(8, 2), r"encoder\.layers\.0\.out_proj: MultiheadAttention"),
    ],
)
def test_a_layer_that_reads_its_weights_past_the_adapters_is_refused(layer: nn.Module, place: str) -> None:
    policy, method = _Fused(layer), build_method("lora", {})
    with pytest.raises(InputError, match=f"lora would change nothing in {place} reads its weights past"):
        method.prepare(policy, Prior({}))
    assert not any("lora_" in name for name, _ in policy.named_parameters())


def test_a_wrong_variant_is_told_the_nearest_one() -> None:
    with pytest.raises(ValueError, match=r"one of lora, dora, rslora, not 'doar'\. Did you mean 'dora'"):
        build_method("lora", {"variant": "doar"})
