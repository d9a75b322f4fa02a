"""Continual-learning benchmark for robot policies: what a fine-tuned policy learned, and what it forgot."""

import importlib
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from clbench.lazy import lazy_names

if TYPE_CHECKING:
    from clbench.evaluation import Episode as Episode
    from clbench.evaluation import Evaluator as Evaluator
    from clbench.method import Metadata as Metadata
    from clbench.method import Method as Method
    from clbench.method import Prior as Prior
    from clbench.method import Progress as Progress
    from clbench.method import Source as Source
    from clbench.method import Stage as Stage
    from clbench.method import Uses as Uses
    from clbench.method import load_method as load_method
    from clbench.method import method_names as method_names
    from clbench.online import evaluate_agent as evaluate_agent
    from clbench.online import next_stage as next_stage
    from clbench.policy import Batch as Batch
    from clbench.policy import Policy as Policy
    from clbench.policy import PolicyConfig as PolicyConfig
    from clbench.policy import QuestionBatch as QuestionBatch
    from clbench.questions import QuestionKind as QuestionKind
    from clbench.record import Record as Record
    from clbench.record import read_record as read_record
    from clbench.registration import register as register
    from clbench.run import execute as execute
    from clbench.run_spec import RunSpec as RunSpec
    from clbench.scenario_env import ScenarioEnv as ScenarioEnv
    from clbench.task import Budget as Budget
    from clbench.task import Scenario as Scenario
    from clbench.task import Task as Task
    from clbench.task import load_scenario as load_scenario
    from clbench.task import scenario_ids as scenario_ids

__version__ = version("clbench")

_HOMES = {
    "evaluation": ("Episode", "Evaluator"),
    "method": (
        "Metadata",
        "Method",
        "Prior",
        "Progress",
        "Source",
        "Stage",
        "Uses",
        "load_method",
        "method_names",
    ),
    "online": ("evaluate_agent", "next_stage"),
    "policy": ("Batch", "Policy", "PolicyConfig", "QuestionBatch"),
    "questions": ("QuestionKind",),
    "record": ("Record", "read_record"),
    "registration": ("register",),
    "run": ("execute",),
    "run_spec": ("RunSpec",),
    "scenario_env": ("ScenarioEnv",),
    "task": ("Budget", "Scenario", "Task", "load_scenario", "scenario_ids"),
}
"""The front door: in which module each public name lives. A name is imported when first used, so that
`import clbench`, which registers the scenarios, costs no import of PyTorch or MuJoCo."""

__all__ = [
    "Batch",
    "Budget",
    "Episode",
    "Evaluator",
    "Metadata",
    "Method",
    "Policy",
    "PolicyConfig",
    "Prior",
    "Progress",
    "QuestionBatch",
    "QuestionKind",
    "Record",
    "RunSpec",
    "Scenario",
    "ScenarioEnv",
    "Source",
    "Stage",
    "Task",
    "Uses",
    "evaluate_agent",
    "execute",
    "load_method",
    "load_scenario",
    "method_names",
    "next_stage",
    "read_record",
    "register",
    "scenario_ids",
]

__getattr__, __dir__ = lazy_names(__name__, _HOMES)


# A wheel has envs/, methods/ and leaderboard/ inside this directory, a checkout beside it.
_HERE = Path(__file__).resolve().parent
if not (_HERE / "envs").is_dir():
    __path__.append(str(_HERE.parent))

importlib.import_module("clbench.envs")  # registers the scenarios with Gymnasium
