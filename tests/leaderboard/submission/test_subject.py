"""What is verified: the run of a record, also if another machine made it."""

import importlib
import platform
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from eager import EAGER
from verification import TOY, edit, failures, verify

from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.spec.scenario import balanced_order

subject = importlib.import_module("clbench.leaderboard.submission.subject")


def test_other_rollouts_on_another_kind_of_machine_prove_nothing(mine: Path, honest: Path) -> None:
    verify(mine, "recomputed", honest)

    def moves_otherwise(values: dict[str, Any]) -> None:
        rollouts, definition = (values["fingerprint"][name] for name in ("rollouts", "definition"))
        rollouts |= dict.fromkeys(rollouts, "0" * 16)
        definition |= {"task left": "0" * 16}

    edit(mine, moves_otherwise)
    assert all(check.passed is not None for check in verify(mine, "recomputed", honest))
    edit(mine, lambda values: values["fingerprint"]["hardware"].update(machine="aarch64"))
    unsure = [check for check in verify(mine, "recomputed", honest) if not check.passed]
    assert [check.name for check in unsure] == ["simulator", "definition"]
    assert all(
        check.passed is None and f"machine aarch64, {platform.machine()} here" in check.found
        for check in unsure
    )


def _subject(spec: RunSpec, scenario: str, **fields: Any) -> Any:
    """Return the record of a run under verification, as far as the tests read it."""
    run = SimpleNamespace(**{**vars(spec), "scenario": scenario.partition(":")[2], **fields})
    request = subject.Request(tier="recomputed", episodes=20, seed=0, scenario=scenario)
    return subject.Subject(SimpleNamespace(record=SimpleNamespace(run=run)), request)


def test_a_record_is_made_again_with_every_choice_of_its_run() -> None:
    choices: dict[str, Any] = {
        "split": "validation",
        "order": 2,
        "perturb": True,
        "policy": "discrete_diffusion",
    }
    spec = RunSpec(TOY, "sft", 3, {"step_factor": 0.3}, "cuda", **choices)
    assert _subject(spec, TOY).spec == spec


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_policy_from_elsewhere_met_the_targets_of_a_balanced_scenario_in_the_published_order(
    elsewhere: bool,
) -> None:
    name = "eager:me/Eager-v0"
    found = _subject(RunSpec(name, "sft", 1), name, trained_elsewhere=elsewhere).learned
    published, own = EAGER.target, tuple(EAGER.target[place] for place in balanced_order(2, 1))
    assert own != published
    assert found.target == (published if elsewhere else own)


@pytest.mark.long
def test_a_record_of_a_method_of_whole_stages_needs_no_episode_before_the_ends_of_stages(
    tmp_path: Path,
) -> None:
    spec = RunSpec(TOY, "weight_interpolation", 0)
    record = execute(spec, tmp_path / "records")
    assert len(record.scenario.evaluation_steps) > 1
    assert failures(verify(spec.path(tmp_path / "records"), "recomputed")) == ""
