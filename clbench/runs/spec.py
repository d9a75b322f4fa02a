"""Run specifications: scenario x method x seed by name, and the same with all names resolved."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from clbench.base.errors import InputError, WrongTypeError
from clbench.base.text import counted, did_you_mean
from clbench.records.paths import label_of, record_path, table_name
from clbench.records.record import RunInfo, ScenarioInfo
from clbench.runs.tuning import tuned_settings
from clbench.spec.fields import check_whole
from clbench.spec.policies import DEFAULT_POLICY, kind_of
from clbench.spec.protocol import LARGEST_SEED, Protocol, ScoredSplit
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.worlds.lanes import check_perturbable

if TYPE_CHECKING:
    from clbench.learning.method import Method

# Methods need PyTorch, whose import takes seconds: it is imported late, so that neither `--help` nor a Ray
# process that passes a spec on waits for it.


@dataclass(frozen=True)
class RunSpec:
    """A run by name: plain data that travels between processes. `resolve` looks the names up, once."""

    scenario: str
    """Gymnasium id of the scenario; "module:id" imports the module first."""
    method: str
    """Name of an installed method, or "module:Class"."""
    seed: int
    """Seed of all random draws of the run."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Hyper-parameters that differ from those tuned for the scenario or, without tuning, from the method's
    defaults, by name."""
    device: str = "cpu"
    """Device on which the policy is computed."""
    split: ScoredSplit = "test"
    """Split to score. Base choices only on "validation" episodes."""
    targets: int | None = None
    """Number of targets to learn, from the first; all if None."""
    order: int = 0
    """Order of the targets, see `Scenario.in_order`; 0 is the published one."""
    perturb: bool = False
    """Whether the retained skills and each stage's target are also evaluated on perturbed episodes."""
    policy: str = DEFAULT_POLICY
    """Name of the policy, see `clbench.spec.policies`."""

    def __post_init__(self) -> None:
        hints = {"scenario": "its id", "method": "its name or 'module:Class'", "device": "such as 'cpu'"}
        for name, hint in hints.items():
            value = getattr(self, name)
            if not isinstance(value, str):
                raise WrongTypeError(f"{name} of a run must be a string, {hint}, not {value!r}.")
        if self.split not in get_args(ScoredSplit):
            raise InputError(f'split of a run must be "test" or "validation", not {self.split!r}.')
        if not isinstance(self.changes, Mapping):
            raise WrongTypeError(f"changes of a run must be values by name, not {self.changes!r}.")
        if type(self.perturb) is not bool:
            raise WrongTypeError(f"perturb of a run must be True or False, not {self.perturb!r}.")
        check_whole(self, 0, "seed", "order", most=LARGEST_SEED)
        if self.targets is not None:
            check_whole(self, 1, "targets")

    def path(self, records: Path) -> Path:
        """Return the path of the record below the folder `records`; it looks all names up."""
        return self.resolve().path(records)

    def resolve(self) -> ResolvedRun:
        """Return the run with its scenario and its method looked up.

        Raises:
            UnknownNameError: There is no such scenario, method or hyper-parameter.
            InputError: There is no such order, nothing can be perturbed, the method refuses a value or has
                one that a record cannot hold, or it needs an ability that the policy lacks.
        """
        from clbench.learning.registry import load_method, read_changes
        from clbench.policy.kinds import check_abilities

        scenario, published = self.scenarios()
        method = load_method(self.method)
        check_abilities(kind_of(self.policy), method.needs, self.method)
        changes = read_changes(self.method, method, self.changes)
        run = ResolvedRun(self, scenario, published, method, changes)
        # refuses a field without a default, or that no record can hold, before any work
        _ = run.defaults, _settings_of(run.new_method())
        return run

    def scenarios(self) -> tuple[Scenario, Scenario]:
        """Return the scenario with the targets that are learned, and the same in the published order.

        Raises:
            UnknownNameError: There is no such scenario or policy.
            InputError: There is no such order, there are fewer targets, or nothing can be perturbed.
        """
        published = load_scenario(self.scenario).with_policy(self.policy)
        if self.targets is not None and self.targets > len(published.target):
            there = counted(len(published.target), "target")
            raise InputError(f"{published.id} has {there}, not {self.targets}.")
        scenario = published.in_order(self.order).for_seed(self.seed)
        if self.perturb:
            check_perturbable(scenario.retained + scenario.target)
        return (
            dataclasses.replace(scenario, target=scenario.target[: self.targets]),
            dataclasses.replace(published, target=published.target[: self.targets]),
        )


@dataclass(frozen=True)
class ResolvedRun:
    """A run whose names have been looked up; code that receives it looks up nothing."""

    spec: RunSpec
    """The run by name."""
    scenario: Scenario
    """Scenario with the targets that are learned, in their order."""
    published: Scenario
    """The same scenario with its targets in the published order."""
    method: type[Method]
    """Class of the method."""
    changes: Mapping[str, Any]
    """Changed hyper-parameters as the method holds them: the text "0.5" may have become a number."""

    def new_method(self) -> Method:
        """Return a new object of the method, with the settings tuned for the scenario and then `changes`.

        A tuning run begins with the defaults instead: an earlier choice must not influence a new one.
        """
        from clbench.learning.registry import new_method

        is_tuning = self.spec.split == "validation"
        tuned = {} if is_tuning else tuned_settings(self.table, self.spec.method)
        return new_method(self.spec.method, self.method, {**tuned, **self.changes})

    @property
    def table(self) -> str:
        """Name of the table that the run belongs to, see `table_name`."""
        return table_name(self.scenario.id, self.spec.policy)

    @cached_property
    def protocol(self) -> Protocol:
        """The evaluation protocol of the run."""
        return self.scenario_info.protocol(self.spec.split, self.spec.perturb)

    @cached_property
    def defaults(self) -> Mapping[str, Any]:
        """The method's default hyper-parameters, neither tuned nor changed, as a record holds them."""
        from clbench.learning.registry import new_method

        return _settings_of(new_method(self.spec.method, self.method, {}))

    @cached_property
    def info(self) -> RunInfo:
        """Content of `Record.run`. Two runs with equal `info` and `scenario_info` are the same run."""
        spec, method = self.spec, self.new_method()
        settings = _settings_of(method)
        return RunInfo(
            scenario=self.scenario.id,
            method=spec.method,
            seed=spec.seed,
            device=spec.device,
            split=spec.split,
            settings=settings,
            changes={name: settings[name] for name in sorted(self.changes)},
            uses=dataclasses.asdict(method.uses),
            order=spec.order,
            perturb=spec.perturb,
            policy=spec.policy,
        )

    @cached_property
    def scenario_info(self) -> ScenarioInfo:
        """Content of `Record.scenario`."""
        return describe_scenario(self.scenario)

    @property
    def label(self) -> str:
        """The method with its changed hyper-parameters, for example "experience_replay+replay=0.02"."""
        return label_of(self.spec.method, self.info.changes)

    def path(self, records: Path) -> Path:
        """Return the path of the record below the folder `records`."""
        spec = self.spec
        return record_path(records, self.scenario.id, self.label, spec.seed, spec.order, spec.policy)


def describe_scenario(scenario: Scenario) -> ScenarioInfo:
    """Return the description of a scenario in a record, the content of `Record.scenario`."""
    groups = (scenario.retained, scenario.target, scenario.held_out)
    retained, target, held_out = ([task.name for task in group] for group in groups)
    steps, budget = list(scenario.budget.evaluation_steps), dataclasses.asdict(scenario.budget)
    return ScenarioInfo(scenario.id, retained, target, held_out, steps, budget, scenario.balanced)


def _settings_of(method: Method) -> dict[str, Any]:
    """Return the hyper-parameters of a method as values of JSON.

    Raises:
        InputError: A record cannot hold one of them.
    """
    found = {}
    for name in (one.name for one in dataclasses.fields(method)):
        value = getattr(method, name)
        if not is_setting(value):
            raise InputError(
                f"{name} of {type(method).__name__} is {value!r}, which a record cannot hold: "
                "hyper-parameters are numbers, Booleans, texts, None, or lists of them."
            )
        try:
            found[name] = json.loads(json.dumps(value, allow_nan=False))
        except ValueError:  # an infinite number
            found[name] = repr(value)
    return found


def is_setting(value: object) -> bool:
    """Return whether a record can hold a value: a number, a Boolean, a text, None, or a list of them."""
    if isinstance(value, list | tuple):
        return all(map(is_setting, value))
    return value is None or isinstance(value, bool | int | float | str)


def check_device(device: str) -> None:
    """Refuse a device that this machine does not have, or on which a run does not repeat itself.

    Raises:
        InputError: PyTorch does not know the name, this machine has no such device, or it is neither a CPU
            nor a CUDA GPU: Apple's `mps` has operations that differ from call to call.
    """
    import torch

    try:
        found = torch.device(device)
        if found.type not in ("cpu", "cuda"):
            raise InputError(
                f"The device {device!r} cannot be used: runs are reproducible only on cpu and cuda."
            )
        if found.type == "cpu" and found.index is not None:
            raise InputError(f"The device {device!r} cannot be used: write 'cpu'.")
        if found.type == "cuda" and (found.index or 0) < torch.cuda.device_count():
            return  # a tensor there would create a context, which keeps workers off a GPU in exclusive mode
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0].partition(". ")[0]  # PyTorch goes on for pages
        hint = did_you_mean(device, {"cpu", "cuda"} - {device})
        raise InputError(f"The device {device!r} cannot be used: {reason.rstrip('.')}.{hint}") from error
