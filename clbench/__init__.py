"""Continual-learning benchmark for robot policies: what a fine-tuned policy learned, and what it forgot."""

import importlib
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clbench.evaluation import Episode, Evaluator
    from clbench.method import Method, Prior, Progress, Source, Stage, Uses, load_method, method_names
    from clbench.policy import Batch, Policy, PolicyConfig, QuestionBatch
    from clbench.questions import QuestionKind
    from clbench.record import Record, read_record
    from clbench.run import RunSpec, execute
    from clbench.scenario_env import ScenarioEnv
    from clbench.task import Budget, Scenario, Task, load_scenario, scenario_ids

__version__ = version("clbench")

_HOMES = {
    "Batch": "policy",
    "Budget": "task",
    "Episode": "evaluation",
    "Evaluator": "evaluation",
    "Method": "method",
    "Policy": "policy",
    "PolicyConfig": "policy",
    "Prior": "method",
    "Progress": "method",
    "QuestionBatch": "policy",
    "QuestionKind": "questions",
    "Record": "record",
    "RunSpec": "run",
    "Scenario": "task",
    "ScenarioEnv": "scenario_env",
    "Source": "method",
    "Stage": "method",
    "Task": "task",
    "Uses": "method",
    "load_method": "method",
    "load_scenario": "task",
    "method_names": "method",
    "read_record": "record",
    "execute": "run",
    "scenario_ids": "task",
}
"""The front door: where each public name lives. They are imported when first used, so that
`import clbench`, which registers the scenarios, costs no import of PyTorch or MuJoCo."""

__all__ = sorted(_HOMES)  # noqa: PLE0605 - a list, made from the table above


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})


# A wheel has envs/, methods/ and leaderboard/ inside this directory, a checkout beside it.
_HERE = Path(__file__).resolve().parent
if not (_HERE / "envs").is_dir():
    __path__.append(str(_HERE.parent))

importlib.import_module("clbench.envs")  # registers the scenarios with Gymnasium
