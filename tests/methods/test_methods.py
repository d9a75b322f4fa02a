"""The purpose of each method, shown on the toy."""

import dataclasses
import re
import sys
import types
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import build_method, weights_of
from torch import nn

import clbench.testing
from clbench.learning.adaptation import adapt
from clbench.learning.method import Method, Stage
from clbench.learning.prior import Access, Prior, Source, UndeclaredAccessError, Uses
from clbench.learning.registry import load_method, method_names
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.records.record import Record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.metrics import METRICS, measure
from clbench.scoring.scores import Scores
from clbench.spec.identifiers import built_in_methods
from clbench.spec.policies import DEFAULT_POLICY, POLICIES
from clbench.testing import check_method
from clbench.testing.small import SMALL, toy_questions, toy_source
from clbench.testing.toy import TOY as SCENARIO

TOY = "clbench.testing:clbench/Toy-v0"
METHODS = ("sft", "experience_replay", "joint", "frozen", "from_scratch")


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Scores]:
    records = tmp_path_factory.mktemp("records")
    return {method: Scores.from_record(execute(RunSpec(TOY, method, 0), records)) for method in METHODS}


def _value(scores: dict[str, Scores], method: str, metric: str) -> float:
    value = measure(metric, scores[method])
    assert value is not None
    return value


def test_sft_learns_the_targets_and_forgets_the_skills(scores: dict[str, Scores]) -> None:
    assert _value(scores, "sft", "adaptation") >= 0.9
    assert _value(scores, "sft", "retention") <= 0.2


def test_replay_keeps_skills_that_sft_loses(scores: dict[str, Scores]) -> None:
    assert _value(scores, "experience_replay", "retention") > _value(scores, "sft", "retention") + 0.2


def test_joint_keeps_the_answers(scores: dict[str, Scores]) -> None:
    assert _value(scores, "joint", "question_retention") >= 0.9


def test_frozen_learns_nothing(scores: dict[str, Scores]) -> None:
    assert _value(scores, "frozen", "adaptation") == 0.0


def test_from_scratch_knows_nothing_but_the_last_target(scores: dict[str, Scores]) -> None:
    assert _value(scores, "from_scratch", "retention") == 0.0
    assert _value(scores, "from_scratch", "question_retention") < 0.2


# ---- every method ------------------------------------------------------------------------------------------


FEWER: dict[str, dict[str, Any]] = {
    "aegis": {"samples": 50},
    "ewc": {"samples": 4},
    "fast_dvla": {"steps": 3},
}
"""Settings that make the preparation short."""


OF_THE_KIND = ("aegis", "lora", "lwf", "stop_gradient")
"""Methods that use what differs between kinds of policy: hidden states, modules, outputs and gradients."""


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "policy"),
    [
        pytest.param(
            name,
            policy,
            marks=[] if policy == DEFAULT_POLICY or name in OF_THE_KIND else [pytest.mark.slow],
        )
        for name in method_names()
        for policy in POLICIES
    ],
)
def test_every_method_keeps_the_contract_with_every_policy(name: str, policy: str) -> None:
    check_method(load_method(name), policy=policy, **FEWER.get(name, {}))


@pytest.mark.parametrize("name", sorted({*method_names()} - {"from_scratch"}))  # which starts anew
def test_what_a_policy_freezes_stays_frozen(name: str) -> None:
    policy, method = TransformerPolicy(SMALL), build_method(name, FEWER.get(name, {}))
    policy.backbone_layers[0].requires_grad_(False)
    prior = Prior({"demonstrations": toy_source("left"), "questions": toy_questions()})
    method.prepare(policy, prior)
    frozen = {id(one) for one in policy.backbone_layers[0].parameters() if not one.requires_grad}
    names = {key for key, one in policy.named_parameters() if id(one) in frozen and "lora_" not in key}
    before = weights_of(policy)
    adapt(policy, method, Stage(1, SCENARIO.task("right"), 0, 3, toy_source("right"), prior), SCENARIO.budget)
    after = weights_of(policy)
    assert {key for key, weight in before.items() if not torch.equal(after[key], weight)}.isdisjoint(names)
    assert names


@pytest.mark.parametrize("name", method_names())
def test_the_link_of_a_method_is_the_first_paper_that_its_module_names(name: str) -> None:
    cls = load_method(name)
    papers = re.findall(r"arXiv\s(\d{4}\.\d{5})", sys.modules[cls.__module__].__doc__ or "")
    mine = papers and not cls.uses.reference
    assert cls.metadata.link == (f"https://arxiv.org/abs/{papers[0]}" if mine else None)


CONSFT = {"tau_start": 0.003, "tau_end": 5.0, "kappa": 25.0, "decay": 0.8, "curvature": 3.5}
CONSFT |= {"omega_min": 0.001, "schedule": 1.0}
CALIBRATED = {**CONSFT, "loss_scale": 0.003}
DEFAULTS: dict[str, tuple[dict[str, Any], Any]] = {
    "aegis": ({"samples": 3000, "direction": "anchor"}, None),
    "buffered_replay": ({"share": 0.02, "replay": 0.5}, ("replay", (0.75, 0.9))),
    "co_training": ({"auxiliary": 1.0}, ("auxiliary", (0.3, 3.0))),
    "consft": ({**CONSFT, "loss_scale": 1.0}, ("tau_start", (0.03, 0.3))),
    "consft_calibrated": (CALIBRATED, ("loss_scale", (0.001, 0.01))),
    "constant_weight": (CALIBRATED, ("loss_scale", (0.001, 0.01))),
    "ewc": ({"strength": 1e4, "samples": 256}, ("strength", (1e3, 1e5))),
    "experience_replay": ({"replay": 0.5}, ("replay", (0.75, 0.9))),
    "fast_dvla": (
        {
            "alpha": 1.1,
            "orthogonal": 1e-4,
            "auxiliary": 1.0,
            "steps": 150,
            "step_size": 3e-4,
            "direction": "capability",
        },
        ("orthogonal", (1e-2, 1.0)),
    ),
    "finch": ({"kappa": 0.3, "momentum": 0.9}, ("kappa", (0.1, 1.0))),
    "from_scratch": ({}, ("step_factor", (2.2, 5.0))),
    "knowledge_insulation": ({"alpha": 1.0}, None),
    "l2_sp": ({"strength": 0.3}, ("strength", (0.1, 1.0))),
    "lora": ({"rank": 16, "alpha": 32.0, "variant": "lora", "speed": 3.0}, ("rank", (4, 64))),
    "lwf": ({"strength": 0.1}, ("strength", (0.01, 1.0))),
    "shuffled_weights": (CALIBRATED, ("loss_scale", (0.001, 0.01))),
    "weight_interpolation": ({"coefficient": 0.5}, ("coefficient", (0.7, 0.9))),
}
"""Hyper-parameters of the methods that have some, and what tuning tries: from papers, or chosen on validation
episodes. Records hold other values only where a run or tuning changed them."""


@pytest.mark.parametrize("name", built_in_methods())
def test_a_method_has_the_published_defaults_and_tuning_tries_the_published_values(name: str) -> None:
    cls = load_method(name)
    settings, tunes = DEFAULTS.get(name, ({}, None))
    assert dataclasses.asdict(cls()) == {"step_factor": 1.0, **settings}
    assert cls.tunes == tunes


@pytest.fixture
def short_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Record]:
    """Return a function that runs a method on the toy with two steps for each target."""
    budget = dataclasses.replace(
        clbench.testing.TOY.budget,
        adaptation_steps=2,
        evaluation_points=1,
        validation_episodes=1,
        test_episodes=2,
        curve_episodes=1,
        test_questions=20,
    )
    monkeypatch.setattr(clbench.testing, "TOY", dataclasses.replace(clbench.testing.TOY, budget=budget))
    return lambda method, **changes: execute(RunSpec(TOY, method, 0, changes), tmp_path)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "preparing", "adapting"),
    [
        ("fast_dvla", 2 * 3, 2),
        ("frozen", 0, 0),
        ("joint", 0, 2),
        ("lora", 0, 2),
        ("weight_interpolation", 0, 2),
    ],
)
def test_a_run_records_its_uses_and_costs_and_has_every_metric(
    name: str, preparing: int, adapting: int, short_run: Callable[..., Record]
) -> None:
    record = short_run(name, **FEWER.get(name, {}))
    assert record.error is None
    assert record.run.uses == dataclasses.asdict(load_method(name).uses)
    scores = Scores.from_record(record)
    values = {
        metric.name: measure(metric.name, scores) for metric in METRICS.values() if not metric.references
    }
    # a share of the highest success has no value where there is none
    missing = {metric for metric, value in values.items() if value is None and not metric.endswith("_cora")}
    adapted = {"update_sparsity"} if record.costs.parameters_added else set()
    # the stages of the toy have no criterion
    to_criterion = {"criterion_met", "steps_to_criterion", "instruction_capture", "relearning_steps"}
    assert missing == {"perturbed_retention", "perturbed_adaptation", *to_criterion, *adapted}
    assert all(
        METRICS[metric].low <= value <= METRICS[metric].high for metric, value in values.items() if value
    )
    assert record.costs.preparation_steps == preparing
    assert record.costs.optimiser_steps == 2 * adapting + preparing
    assert ((record.costs.parameters_added or 0) > 0) == (name == "lora")


@pytest.mark.long
@pytest.mark.parametrize("declared", ["never", "prepare", "throughout"])
@pytest.mark.parametrize("kind", ["demonstrations", "questions"])
def test_prior_data_can_be_touched_in_the_hooks_that_are_declared_and_in_no_other(
    kind: str, declared: Access, short_run: Callable[..., Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    touched, refused = set(), set()
    declaration: dict[str, Any] = {kind: declared}

    def touch(hook: str, prior: Prior) -> None:
        try:
            getattr(prior, kind).sample(1)
            touched.add(hook)
        except UndeclaredAccessError:
            refused.add(hook)

    @dataclasses.dataclass
    class Curious(Method):
        uses = Uses(**declaration)

        def prepare(self, policy: Policy, prior: Prior) -> None:
            touch("prepare", prior)

        def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
            touch("start_task", stage.prior)
            return policy.parameters()

        def batch(self, target: Source[Batch], prior: Prior) -> Batch:
            touch("batch", prior)
            return target.sample(4)

        def end_task(self, policy: Policy, stage: Stage) -> None:
            touch("end_task", stage.prior)

    module = types.ModuleType("stranger")
    module.__dict__["Curious"] = Curious
    monkeypatch.setitem(sys.modules, "stranger", module)
    record = short_run("stranger:Curious")
    assert record.error is None
    hooks = {"prepare", "start_task", "batch", "end_task"}
    allowed = {"never": set(), "prepare": {"prepare"}, "throughout": hooks}[declared]
    assert (touched, refused) == (allowed, hooks - allowed)
    never = {"demonstrations": "never", "questions": "never", "reference": False}
    assert record.run.uses == {**never, **declaration}
    assert ((record.costs.bytes_kept or 0) > 0) == (declared == "throughout")


NUMBERS = [
    (name, field.name)
    for name in method_names()
    for field in dataclasses.fields(load_method(name))
    if isinstance(field.default, int | float)
]


@pytest.mark.parametrize("value", [-1, float("nan")])
@pytest.mark.parametrize(("name", "field"), NUMBERS)
def test_no_hyper_parameter_of_any_method_may_be_negative_or_no_number(
    name: str, field: str, value: float
) -> None:
    with pytest.raises(ValueError, match=rf"{name}.*: {field} must be .*, not {value}"):
        build_method(name, {field: value})


@pytest.mark.parametrize(
    ("name", "field", "value", "allowed"),
    [
        ("aegis", "direction", "away", "one of anchor, random, not 'away'"),
        ("aegis", "samples", 0, "from 1, not 0"),
        ("buffered_replay", "replay", 1.5, "from 0 to 1, not 1.5"),
        ("buffered_replay", "share", 1.5, "from 1e-09 to 1, not 1.5"),
        ("consft", "omega_min", 1.5, "from 0 to 1, not 1.5"),
        ("consft", "tau_start", 0.0, "from 1e-09, not 0.0"),
        ("consft", "tau_end", 0.0, "from 1e-09, not 0.0"),
        ("consft", "kappa", 0.0, "from 1e-09, not 0.0"),
        ("consft", "decay", 0.0, "from 1e-09, not 0.0"),
        ("consft", "curvature", 0.0, "from 1e-09, not 0.0"),
        ("consft", "schedule", 0.0, "from 1e-09, not 0.0"),
        ("ewc", "samples", 0, "from 1, not 0"),
        ("experience_replay", "replay", 1.5, "from 0 to 1, not 1.5"),
        ("fast_dvla", "direction", "none", "one of capability, random, not 'none'"),
        ("fast_dvla", "steps", 0, "from 1, not 0"),
        ("fast_dvla", "step_size", 0.0, "from 1e-12, not 0.0"),
        ("finch", "kappa", 0.0, "from 1e-09, not 0.0"),
        ("finch", "momentum", 1.5, "from 0 to 1, not 1.5"),
        ("lora", "alpha", 0.0, "from 1e-09, not 0.0"),
        ("lora", "rank", 0, "from 1, not 0"),
        ("lora", "speed", 0.0, "from 1e-09, not 0.0"),
        ("lora", "variant", "qlora", "one of lora, dora, rslora, not 'qlora'"),
        ("weight_interpolation", "coefficient", 1.5, "from 0 to 1, not 1.5"),
    ],
)
def test_a_hyper_parameter_out_of_range_is_refused_with_its_name_and_range(
    name: str, field: str, value: Any, allowed: str
) -> None:
    with pytest.raises(ValueError, match=f"{name} refuses its hyper-parameters: {field} must be {allowed}"):
        build_method(name, {field: value})
