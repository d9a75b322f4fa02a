"""What is run: scenario x method x seed, and how long that takes, before any of it is done."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clbench.base.errors import InputError
from clbench.records.paths import label_of, record_path
from clbench.records.reader import RecordError, read_record
from clbench.spec.protocol import Split
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.worlds.lanes import check_perturbable

if TYPE_CHECKING:
    from clbench.learning.method import Method

# PyTorch, which methods need, is imported late: that takes seconds, for which neither `--help` nor a process
# of Ray that passes a spec on waits.

EPISODE_WEIGHT = 0.3
"""What an evaluation episode takes, in optimiser steps; for the time left that a progress bar shows."""


@dataclass(frozen=True)
class RunSpec:
    """What is run."""

    scenario: str
    """Gymnasium id of the scenario."""
    method: str
    """Name of an installed method, or "module:Class"."""
    seed: int
    """Of every draw of the run."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Hyper-parameters that differ from the method's own."""
    device: str = "cpu"
    """Where the policy is computed."""
    split: Split = "test"
    """Which episodes it is evaluated on; those of "validation" may be looked at to choose settings."""
    targets: int | None = None
    """How many targets are learned, from the first; all if None."""
    order: int = 0
    """In which order the targets come, as `Scenario.in_order` says; 0 is the published one."""
    perturb: bool = False
    """Whether the retained skills are evaluated on perturbed episodes too."""

    def path(self, records: Path) -> Path:
        """Return where the record lies below the folder `records`."""
        return record_path(records, self.scenario.rpartition(":")[2], self.label, self.seed, self.order)

    def load(self) -> Scenario:
        """Return the scenario, with the targets that are learned.

        Raises:
            LookupError: There is no such scenario.
            ValueError: There is no such order, or nothing that can be perturbed.
        """
        scenario = load_scenario(self.scenario).in_order(self.order)
        if self.perturb and not scenario.retained:
            raise InputError(f"{scenario.id} retains no skills that could be perturbed: leave out --perturb.")
        if self.perturb:
            check_perturbable(scenario.retained)
        return dataclasses.replace(scenario, target=scenario.target[: self.targets])

    @property
    def label(self) -> str:
        """The method and what was changed of it, as "experience_replay+replay=0.02"."""
        return label_of(self.method, self.changes)

    def build(self) -> Method:
        """Return a new object of the method."""
        from clbench.learning.registry import build_method

        return build_method(self.method, self.changes)

    def describe(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return `Record.run` and `Record.scenario`: two runs for which they are equal are the same run."""
        scenario, method = self.load(), self.build()
        values = dataclasses.asdict(method)  # type: ignore[call-overload]
        settings = {name: _plain(value) for name, value in values.items()}
        run = {
            "scenario": scenario.id,
            "method": self.method,
            "seed": self.seed,
            **({"order": self.order} if self.order else {}),
            "device": self.device,
            "split": self.split,
            **({"perturb": True} if self.perturb else {}),
            "settings": settings,
            "changes": {name: settings[name] for name in sorted(self.changes)},
            "uses": dataclasses.asdict(method.uses),
        }
        return run, describe_scenario(scenario)


def describe_scenario(scenario: Scenario) -> dict[str, Any]:
    """Return `Record.scenario`."""
    groups = ("retained", "target", "held_out")
    return {
        "id": scenario.id,
        **{group: [task.name for task in getattr(scenario, group)] for group in groups},
        "evaluation_steps": list(scenario.budget.evaluation_steps),
        "budget": dataclasses.asdict(scenario.budget),
    }


def _plain(value: Any) -> Any:
    """Return a value as JSON holds it; what it cannot hold becomes text."""
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError):
        return repr(value)


def has_record(spec: RunSpec, records: Path) -> bool:
    """Return whether this very run went through before, or one that has perturbed episodes besides.

    One that failed, that cannot be read, or that is of another budget, device or settings does not count.
    """
    try:
        record = read_record(spec.path(records))
    except RecordError:
        return False
    if not spec.perturb:
        record.run.pop("perturb", None)
    return record.status == "success" and (record.run, record.scenario) == spec.describe()


def run_length(scenario: Scenario, split: Split = "test", perturb: bool = False) -> float:
    """Return how long a run takes, in optimiser steps.

    Args:
        scenario: With the targets that are learned.
        split: Episodes that it is evaluated on.
        perturb: Whether the retained skills are evaluated on perturbed episodes too.
    """
    budget, stages, retained = scenario.budget, len(scenario.target), len(scenario.retained)
    points = len(budget.evaluation_steps)
    scored = split == "test"
    on_the_way = stages * (points - 1) * (retained + 1)
    on_the_way *= budget.curve_episodes if scored else budget.validation_episodes
    selection = stages * points * budget.validation_episodes if scored else 0
    ends = (stages + 1) * end_length(scenario, split, perturb)
    return stages * budget.adaptation_steps + ends + EPISODE_WEIGHT * (on_the_way + selection)


def end_length(scenario: Scenario, split: Split, perturb: bool) -> float:
    """Return how long the evaluation of all tasks takes, as at the end of a stage, in optimiser steps."""
    budget = scenario.budget
    perturbed = len(scenario.retained) * budget.episodes("perturbed") if perturb else 0
    return EPISODE_WEIGHT * (len(scenario.tasks) * budget.episodes(split) + perturbed)


def read_changes(method: str, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return changed hyper-parameters as the method holds them: the text "0.5" may be a number."""
    from clbench.learning.registry import build_method

    built = build_method(method, changes)
    return {name: getattr(built, name) for name in changes}


def check_device(device: str) -> None:
    """Refuse a device that is not here.

    Raises:
        ValueError: The name is none that PyTorch knows, or this machine has no such device.
    """
    import torch

    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"The device {device!r} cannot be used: {reason}") from error
