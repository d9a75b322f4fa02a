"""Tuning: the settings that every method tries on a scenario, the choice among them, and its file.

All methods try the same number of settings, on the same seeds, with all targets, and only on validation
episodes:

1. `RUNGS`: four factors of the learning rate, with the method's own strength at its default.
2. Two more settings at the best of these rungs: two other values of the strength that the method declares in
   `Method.tunes` or, if it declares none, two learning rates, one on each side of the rung. Next to the
   lowest and the highest rung, one of the two lies outside the ladder: such a method may try 0.0165, which
   others cannot.

Among the settings whose success on the targets right after learning is at least `LEARNED`, the one with the
best final average wins. A hyper-parameter that the scenario determines, such as the length of a schedule, is
fixed: it has the same value in all six settings.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clbench.base.errors import InputError
from clbench.base.lease import Lease
from clbench.base.leftovers import replacing
from clbench.base.strict_json import StrictJSONError, read_json
from clbench.records.paths import table_parts
from clbench.spec.identifiers import folder_name, scenario_ids

if TYPE_CHECKING:
    from clbench.learning.method import Method

RUNGS = (1.0, 0.3, 0.1, 0.03)
"""Factors of the learning rate, for every method."""

BETWEEN = (0.55, 1.8)
"""Factors of the best rung, for methods without a strength of their own: half a rung down and up."""

LEARNED = 0.8
"""Lowest mean success on the targets, right after learning them, with which a setting may be chosen."""

CONTROL_OF = {"constant_weight": "consft_calibrated", "shuffled_weights": "consft_calibrated"}
"""Controls, each with the method from which it differs in one thing. A control has the settings that were
tuned for this method, so that nothing else differs."""

Settings = Mapping[str, Any]


@dataclass(frozen=True)
class Tried:
    """One setting of a method, with its scores on validation episodes, averaged over the tuning seeds."""

    settings: dict[str, Any]
    """Hyper-parameters that tuning sets, by name."""
    final_average: float | None
    """Success after the last target on everything that was ever trained; None if a run failed."""
    learned: float | None
    """Success on each target right after it was learned; None if a run failed."""

    @property
    def learns_enough(self) -> bool:
        """Whether the success on the targets is at least `LEARNED`."""
        return self.learned is not None and self.learned >= LEARNED


@dataclass(frozen=True)
class Tuned:
    """The settings of a method that tuning chose for a scenario."""

    settings: dict[str, Any]
    """Hyper-parameters that tuning chose, by name."""
    tried: tuple[Tried, ...]
    """All settings that it tried, in their order."""


def rungs(method: type[Method], fixed: Settings | None = None) -> list[dict[str, Any]]:
    """Return the settings that a method tries first: the ladder of learning rates, with the fixed values.

    Raises:
        InputError: A fixed hyper-parameter is one that tuning sets, or the method refuses what it `tunes`.
    """
    fixed = fixed or {}
    _check_tunes(method)
    clash = next((name for name in fixed if name in _set_by_tuning(method)), None)
    if clash is not None:
        raise InputError(f"Tuning {method.__name__} sets {clash}: it cannot be fixed.")
    defaults = {name: getattr(method(), name) for name in _set_by_tuning(method)}
    return [{**fixed, **defaults, "step_factor": factor} for factor in RUNGS]


def _check_tunes(method: type[Method]) -> None:
    """Refuse unusable `tunes` before the first run, rather than when their turn comes."""
    from clbench.learning.registry import new_method  # imports torch

    tried = values_of_strength(method)
    if tried is None:
        raise InputError(
            f"tunes of {method.__name__} must be the name of a field and two values of it, (name, (a, b)), "
            f"not {method.tunes!r}."
        )
    for settings in tried:
        try:
            new_method(method.__name__, method, settings)
        except InputError as error:
            raise InputError(f"tunes of {method.__name__}: {error}") from error


def values_of_strength(method: type[Method]) -> list[dict[str, Any]] | None:
    """Return the values of its own strength that a method tries; None if its `tunes` have a wrong form."""
    match method.tunes:
        case None:
            return []
        case (str(name), (_, _) as values) if name in {field.name for field in fields(method)}:
            return [{name: value} for value in values]
        case _:
            return None


def refinements(method: type[Method], best: Settings) -> list[dict[str, Any]]:
    """Return the settings that a method tries next, around the best of its first ones."""
    if method.tunes is None:
        return [{**best, "step_factor": round(share * best["step_factor"], 4)} for share in BETWEEN]
    name, values = method.tunes
    return [{**best, name: value} for value in values]


def best_of(tried: Sequence[Tried]) -> Tried:
    """Return the setting with the best final average among those that learn enough.

    If none learns enough, return the one that learns most. The first one wins a tie. A setting with a failed
    run is not chosen; at least one setting must have none.
    """
    return rated_best(tried)[0]


def rated_best(tried: Sequence[Tried]) -> list[Tried]:
    """Return the setting that `best_of` chooses, and those with the same score after it."""
    learners = [one for one in tried if one.learns_enough]
    if not learners:
        most = max(one.learned or 0.0 for one in tried)
        return [one for one in tried if one.learned == most]
    best = max(one.final_average or 0.0 for one in learners)
    return [one for one in learners if one.final_average == best]


def tuned_file(table: str) -> Path:
    """Return the path of the file with the settings for a table, which need not exist.

    Args:
        table: The id of a scenario, with the policy if it is not the default one; see `table_name`.
    """
    methods = find_spec("clbench.methods")
    assert methods is not None
    assert methods.origin is not None
    return Path(methods.origin).parent / "tuned" / f"{folder_name(table)}.json"


def check_tuned(path: Path, table: str, seeds: Sequence[int], methods: Iterable[str]) -> None:
    """Refuse to write the settings of `methods`, tuned on `seeds`, to `path` beside others.

    Raises:
        InputError: The other settings are for another scenario or policy, or were tuned on other seeds, or
            the file has no settings.
    """
    if not path.exists():
        return
    content = _settings_in(path)
    if content["scenario"] != table:
        raise InputError(
            f"{path} has the settings of {content['scenario']}, not of {table}: write to another file."
        )
    if content["methods"].keys() - set(methods) and content["seeds"] != list(seeds):
        raise InputError(
            f"{path}: its other methods were tuned on seeds {content['seeds']}, not {list(seeds)}; "
            "write to another file, or tune all methods again."
        )


def _settings_in(path: Path) -> dict[str, Any]:
    """Return the content of a file that `write_tuned` wrote.

    Raises:
        InputError: The file has other content, or is a folder.
    """
    kinds = {"scenario": str, "seeds": list, "methods": dict}
    try:
        content: dict[str, Any] = read_json(path)
    except StrictJSONError as error:
        raise InputError(f"{path} is not a settings file of clbench tune: {error}") from error
    whole = isinstance(content, dict) and all(isinstance(content.get(key), kinds[key]) for key in kinds)
    if not whole:
        raise InputError(f"{path} is not a settings file of clbench tune: write to another file.")
    return content


def write_tuned(path: Path, table: str, seeds: Sequence[int], methods: Mapping[str, Tuned]) -> None:
    """Write the settings of `methods` to `path`, and keep the settings of other methods that it has already.

    Raises:
        InputError: `check_tuned` refuses to write them.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with Lease(path).held():  # another command may add a method at the same time
        check_tuned(path, table, seeds, methods)
        known = {name: asdict(one) for name, one in methods.items()}
        if path.is_file():
            known = {**_settings_in(path)["methods"], **known}
        content = {"scenario": table, "seeds": list(seeds), "methods": dict(sorted(known.items()))}
        with replacing(path) as partial:  # a full disk must not destroy the settings of the others
            partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    tuned.cache_clear()


def fixed_settings(method: type[Method], found: Tuned) -> dict[str, Any]:
    """Return the hyper-parameters that tuning was told to fix, with their values."""
    return {name: value for name, value in found.settings.items() if name not in _set_by_tuning(method)}


def _set_by_tuning(method: type[Method]) -> tuple[str, ...]:
    """Return the hyper-parameters that tuning sets: the learning rate, and the method's strength, if any."""
    return ("step_factor",) if method.tunes is None else (method.tunes[0], "step_factor")


@cache
def tuned(table: str) -> Mapping[str, Tuned]:
    """Return what tuning chose for a table, by method; empty if the table was never tuned.

    Controls have the settings that were chosen for their methods.
    """
    path = tuned_file(table)
    if not path.is_file():
        return {}
    methods = {
        name: Tuned(found["settings"], tuple(Tried(**one) for one in found["tried"]))
        for name, found in read_json(path)["methods"].items()
    }
    controls = {control: methods[method] for control, method in CONTROL_OF.items() if method in methods}
    return {**methods, **controls}


def tuned_scenarios() -> list[str]:
    """Return the ids of the registered scenarios on which methods were tuned, sorted."""
    return [name for name in scenario_ids() if tuned(name)]


def tuned_settings(table: str, method: str) -> dict[str, Any]:
    """Return the settings that tuning chose for a method; empty if it was not tuned on the scenario.

    With another policy, a method that was not tuned for it has the settings for the default policy.
    """
    found = tuned(table).get(method) or tuned(table_parts(table)[0]).get(method)
    return dict(found.settings) if found else {}
