"""Records of older schemas, converted to the present one while they are read. Their files stay as they are.

Schema 4 knew one kind of policy. The world and the camera of FetchPixels were in other modules.

Schema 3 did not measure how often the latest target captures the instructions of other skills.

Schema 2 wrote "report" for the split "test" and "selection" for "validation", named four fields of the budget
after these words, and left out `order`, `perturb` and costs where they had their usual values. Its stages had
no criterion, the shift of the policy was not measured, and nothing was relearned.

Schema 1 knew no tuning runs, evaluated only the target before the end of a stage, on all test episodes and at
equal intervals, asked questions only at the ends of stages, and did not measure changes of the policy. All of
this follows from its budget, so its records are converted without guessing. Metrics of quantities that it did
not measure are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from clbench.base.errors import InputError
from clbench.records.record import CheckRow

SPLITS = {"report": "test", "selection": "validation"}
"""Splits of schemas 1 and 2, with their present names."""

BUDGET = {
    "perturbation": "noisy_demonstrations",
    "report_questions": "test_questions",
    "selection_episodes": "validation_episodes",
    "report_episodes": "test_episodes",
}
"""Fields of the budget of schemas 1 and 2 that have another name now, with that name."""

COSTS = (
    "optimiser_steps",
    "parameters",
    "preparation_steps",
    "parameters_added",
    "bytes_kept",
    "environment_steps",
)
"""All costs. Schemas 1 and 2 left out those that were not known."""

POLICY = ("stage", "step", "update_sparsity", "activation_drift")
"""Columns of the table of changes of the policy in schema 2."""

MOVED = {
    "clbench.envs.fetch.pixel_world:FetchPixelsWorld": "clbench.envs.fetch_pixels.world:FetchPixelsWorld",
    "clbench.envs.fetch.camera:FetchCamera": "clbench.envs.fetch_pixels.camera:FetchCamera",
}
"""Names of a world and a camera up to schema 4, with their present names."""

_Values = dict[str, Any]


def to_present(values: Mapping[str, Any], schema: int) -> _Values:
    """Return the fields of a record of an older schema under the names and words of the present one.

    A field that does not have its old form stays as it is: the reader refuses it.

    Args:
        values: The record's fields as read from JSON, without its `schema`.
        schema: Schema of the record.

    Raises:
        InputError: A field is of a later schema, or holds what its own does not allow.
    """
    converted = dict(values)
    for step in _STEPS[schema - 1 :]:
        converted = step(converted)
    return converted


def _from_1(values: _Values) -> _Values:
    """Convert schema 1 to schema 2."""
    _refuse_later("a record", values, ("policy",), 1)
    run, scenario, answers, diagnostics = (
        _part(values, name) for name in ("run", "scenario", "answers", "diagnostics")
    )
    if run is not None:
        _refuse_later("run", run, ("split", "order", "perturb"), 1)
        run["split"] = "report"
    end = None
    if scenario is not None:
        _refuse_later("scenario", scenario, ("evaluation_steps",), 1)
        budget = _part(scenario, "budget")
        if budget is not None:
            _refuse_later("budget", budget, ("curve_episodes",), 1)
            steps = _equal_steps(budget.get("adaptation_steps"), budget.get("evaluation_points"))
            end, scenario["evaluation_steps"] = steps[-1], steps
            scenario["budget"] = {**budget, "curve_episodes": budget.get("report_episodes")}
    if answers is not None and isinstance(answers.get("stage"), list):
        _refuse_later("answers", answers, ("step",), 1)
        stages = answers.pop("stage")
        answers = {"stage": stages, "step": [end if stage else 0 for stage in stages], **answers}
    if diagnostics and scenario is not None and isinstance(scenario.get("target"), list):
        diagnostics = {str(len(scenario["target"])): diagnostics}  # reported once, at the end
    changed = {"run": run, "scenario": scenario, "answers": answers, "diagnostics": diagnostics}
    return {**_with(values, changed), "policy": {name: [] for name in POLICY}}


def _equal_steps(last: Any, points: Any) -> list[int]:
    """Return the evaluation steps of schema 1, at equal intervals up to the last one."""
    if type(last) is not int or type(points) is not int or not 1 <= points <= 100 or last < 1:
        raise InputError(
            "scenario: adaptation_steps and evaluation_points of its budget must be whole numbers."
        )
    points = min(points, last)
    return [round((point + 1) * last / points) for point in range(points)]


def _from_2(values: _Values) -> _Values:
    """Convert schema 2 to schema 3."""
    run, scenario, episodes, policy, costs = (
        _part(values, name) for name in ("run", "scenario", "episodes", "policy", "costs")
    )
    if run is not None:
        _check_usual(run)
        run = {**run, "order": run.get("order", 0), "perturb": run.get("perturb", False)}
        uses, settings = _part(run, "uses"), _part(run, "settings")
        if settings is not None and not (uses or {}).get("online"):
            _refuse_later("settings", settings, ("step_factor",), 2)
            run["settings"] = {"step_factor": 1.0, **settings}
        if "split" in run:
            run["split"] = _split(run["split"], "run: split")
    if scenario is not None and (budget := _part(scenario, "budget")) is not None:
        _refuse_later("budget", budget, (*BUDGET.values(), "criterion"), 2)
        renamed = {BUDGET.get(name, name): value for name, value in budget.items()}
        scenario["budget"] = {**renamed, "criterion": None}
    if scenario is not None:
        _refuse_later("scenario", scenario, ("balanced",), 2)
        scenario["balanced"] = False
    if episodes is not None and isinstance(episodes.get("split"), list):
        episodes["split"] = [_split(split, "episodes: split") for split in episodes["split"]]
    if costs is not None:
        costs = {**dict.fromkeys(COSTS), **costs}
    if policy is not None and isinstance(policy.get("stage"), list):
        _refuse_later("policy", policy, ("shift",), 2)
        policy["shift"] = [None] * len(policy["stage"])
    _refuse_later("a record", values, ("checks", "relearning"), 2)
    changed = {"run": run, "scenario": scenario, "episodes": episodes, "policy": policy, "costs": costs}
    checks: _Values = {name: [] for name in CheckRow._fields}
    return {**_with(values, changed), "checks": checks, "relearning": None}


def _from_3(values: _Values) -> _Values:
    """Convert schema 3 to schema 4."""
    policy = _part(values, "policy")
    if policy is not None and isinstance(policy.get("stage"), list):
        _refuse_later("policy", policy, ("captured",), 3)
        policy["captured"] = [None] * len(policy["stage"])
    return _with(values, {"policy": policy})


def _from_4(values: _Values) -> _Values:
    """Convert schema 4 to schema 5."""
    run = _part(values, "run")
    if run is not None:
        _refuse_later("run", run, ("policy",), 4)
        run["policy"] = "flow"
    fingerprint = _part(values, "fingerprint")
    if fingerprint is not None and (rollouts := _part(fingerprint, "rollouts")) is not None:
        fingerprint["rollouts"] = {MOVED.get(name, name): value for name, value in rollouts.items()}
    return _with(values, {"run": run, "fingerprint": fingerprint})


_STEPS: tuple[Callable[[_Values], _Values], ...] = (_from_1, _from_2, _from_3, _from_4)
"""Functions that convert each schema, from 1, to the next one."""


def _part(values: _Values, name: str) -> _Values | None:
    """Return a copy of an object inside another, or None if there is none."""
    found = values.get(name)
    return dict(found) if isinstance(found, dict) else None


def _with(values: _Values, changed: Mapping[str, _Values | None]) -> _Values:
    """Return `values` with the parts that were changed; a part that is None stays as it was."""
    return {**values, **{name: part for name, part in changed.items() if part is not None}}


def _refuse_later(where: str, values: Mapping[str, Any], names: Iterable[str], schema: int) -> None:
    """Refuse fields that only a later schema has."""
    for name in names:
        if name in values:
            raise InputError(f"{where}: schema {schema} has no {name}.")


def _check_usual(run: _Values) -> None:
    """Refuse usual values that schema 2 left out."""
    order, perturb = run.get("order"), run.get("perturb")
    if type(order) is int and order < 1:
        raise InputError("run: order must be above 0 in schema 2; the published order is left out.")
    if perturb is False:
        raise InputError("run: perturb must be true in schema 2; it is left out where nothing was perturbed.")


def _split(word: Any, where: str) -> Any:
    """Return a split under its present name."""
    if word in SPLITS.values():
        raise InputError(f"{where}: schema 2 has no {word}.")
    return SPLITS.get(word, word) if isinstance(word, str) else word
