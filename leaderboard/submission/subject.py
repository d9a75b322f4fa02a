"""The subject of a verification: a record, the run that makes it again, and the results of checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from clbench.learning.registry import method_names
from clbench.runs.fingerprint import fingerprint
from clbench.runs.spec import ResolvedRun, RunSpec, describe_scenario
from clbench.scoring.reading import read_protocol
from clbench.spec.policies import is_built_in
from clbench.spec.protocol import Protocol
from clbench.spec.scenario import Scenario

from ..board.runs import Run

SHOWN = 3
"""Number of differences that a check reports in full."""


@dataclass(frozen=True)
class Check:
    """The result of one check."""

    name: str
    """Subject of the check."""
    found: str
    """Result in words."""
    passed: bool | None
    """Whether the record passed; None if this machine, or the command, cannot tell."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """The options of a verification."""

    tier: str
    """Highest of `TIERS` to check."""
    episodes: int
    """Number of episodes to replay; all replayable ones if there are fewer."""
    seed: int
    """Random seed that selects these episodes. The submitter must not know it."""
    method: str | None = None
    """module:Class of a method that is not installed; the name in a record alone is never imported."""
    scenario: str | None = None
    """module:id of the scenario; None if clbench registers it."""
    checkpoints: Path | None = None
    """Folder of kept policies; if None, they are trained again."""
    pretrain: bool = False
    """Whether the tier "retrained" repeats the pretraining, too, and reads no policy from the cache."""
    by: str | None = None
    """Name of the verifier, if given."""
    policy: str | None = None
    """module:Class of a policy that is not built in; the name in a record alone is never imported."""
    any_processor: bool = False
    """Whether to repeat training even on a processor that may compute differently from the record's."""


@dataclass(frozen=True)
class Subject:
    """A record under verification, with values that several checks need."""

    run: Run
    request: Request

    @property
    def spec(self) -> RunSpec:
        """The run that makes the record again."""
        values = self.run.record.run
        return RunSpec(
            self.request.scenario or values.scenario,
            values.method,
            values.seed,
            values.changes,
            values.device,
            split=values.split,
            order=values.order,
            perturb=values.perturb,
            policy=values.policy,
        )

    @property
    def strange(self) -> list[str]:
        """Names of its method and policy that may not be imported: neither ours nor named by the verifier."""
        run = self.run.record.run
        method = [] if run.method in (*method_names(), self.request.method) else [run.method]
        policy = [] if is_built_in(run.policy) or run.policy == self.request.policy else [run.policy]
        return method + policy

    @cached_property
    def resolved(self) -> ResolvedRun:
        """The run, whose method is imported."""
        return self.spec.resolve()

    @cached_property
    def scenarios(self) -> tuple[Scenario, Scenario]:
        """The verifier's scenario, with the targets in the order of the run and in the published order."""
        return self.spec.scenarios()

    @property
    def scenario(self) -> Scenario:
        """The verifier's scenario, with the targets in the order of the run."""
        return self.scenarios[0]

    @property
    def learned(self) -> Scenario:
        """The verifier's scenario as the run met it: agents and served policies keep the published order."""
        return self.scenarios[1 if self.run.record.run.trained_elsewhere else 0]

    @property
    def protocol(self) -> Protocol:
        """The evaluation protocol of the run, with the ends of its stages."""
        ends = read_protocol(self.run.record).ends
        return describe_scenario(self.scenario).protocol(self.spec.split, self.spec.perturb, ends)

    @cached_property
    def here(self) -> dict[str, Any]:
        """The fingerprint of this machine; it plays a rollout of every world."""
        return fingerprint(self.scenarios[1])

    @property
    def other_processor(self) -> str | None:
        """The record's processor and this one, in words, if they may compute differently; else None.

        Equal results prove a record even if it was made on another processor; different ones prove nothing.
        """
        theirs, ours = (_processor(made) for made in (self.run.record.fingerprint, self.here))
        if all(theirs[name] in (None, value) for name, value in ours.items()):
            return None
        there, here = (
            f"{values['maker'] or 'unknown'} with {values['instructions'] or 'unknown'}"
            for values in (theirs, ours)
        )
        if there == here:
            there, here = (f"{there}, arithmetic {values['arithmetic']}" for values in (theirs, ours))
        return f"its processor: {there}; here: {here}"


def _processor(made: dict[str, Any]) -> dict[str, str | None]:
    """Return what determines the bits of training, according to a fingerprint; None where it lacks a value.

    The maker is the first word of the model. The oldest records lack the instructions, and records from
    before `arithmetic_hash` lack the arithmetic.
    """
    hardware = made.get("hardware")
    values = hardware if isinstance(hardware, dict) else {}
    model, *others = (values.get(name) for name in ("processor", "instructions", "arithmetic"))
    maker = model.split()[0] if isinstance(model, str) and model.strip() else None
    instructions, arithmetic = (value if isinstance(value, str) else None for value in others)
    return {"maker": maker, "instructions": instructions, "arithmetic": arithmetic}


def some(wrong: Sequence[str]) -> str:
    """Return the first differences in words, and the number of the others."""
    more = f", and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
    return f"{'; '.join(wrong[:SHOWN])}{more}"
