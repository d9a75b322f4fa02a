"""Records of older schemas, converted to the present one while they are read. Their files stay as they are.

Schema 4 knew one kind of policy. The world and the camera of FetchPixels were in other modules.

Schema 3 did not measure how often the latest target captures the instructions of other skills.

Schema 2 wrote "report" for the split "test" and "selection" for "validation", named four fields of the budget
after these words, and left out `order`, `perturb` and costs where they had their usual values. Its stages had
no criterion, the shift of the policy was not measured, and nothing was relearned.

No published record has schema 1, so no reader knows it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from clbench.base.errors import InputError

OLDEST = 2
"""Oldest schema that can be read."""

SPLITS = {"report": "test", "selection": "validation"}
"""Splits of schema 2, with their present names."""

BUDGET = {
    "perturbation": "noisy_demonstrations",
    "report_questions": "test_questions",
    "selection_episodes": "validation_episodes",
    "report_episodes": "test_episodes",
}
"""Fields of the budget of schema 2 that have another name now, with that name."""

MOVED = {
    "clbench.envs.fetch.pixel_world:FetchPixelsWorld": "clbench.envs.fetch_pixels.world:FetchPixelsWorld",
    "clbench.envs.fetch.camera:FetchCamera": "clbench.envs.fetch_pixels.camera:FetchCamera",
}
"""Names of a world and a camera up to schema 4, with their present names."""

COSTS = (
    "optimiser_steps",
    "parameters",
    "preparation_steps",
    "parameters_added",
    "bytes_kept",
    "environment_steps",
)
"""Costs of schema 3. Schema 2 leaves out a cost that is not known."""

CHECKS = ("stage", "step", "episodes", "successes")
"""Columns of the checks of schema 3."""

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
    for step in _STEPS[schema - OLDEST :]:
        converted = step(converted)
    return converted


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
    checks: _Values = {name: [] for name in CHECKS}
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


_STEPS: tuple[Callable[[_Values], _Values], ...] = (_from_2, _from_3, _from_4)
"""Functions that convert each schema, from the oldest, to the next one."""


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
