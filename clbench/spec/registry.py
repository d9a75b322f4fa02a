"""Registration of scenarios with Gymnasium, by name alone: a scenario is imported when it is first used."""

from __future__ import annotations

import functools
import logging
import multiprocessing

import gymnasium
from gymnasium.envs import registration

from clbench.base.entry_points import import_module, is_entry_point, resolve
from clbench.base.errors import InputError, UnknownNameError, WrongTypeError
from clbench.base.text import did_you_mean
from clbench.spec.identifiers import check_scenario_id, unknown_scenario
from clbench.spec.scenario import Scenario

LOG = logging.getLogger("clbench")

ENVIRONMENT = "clbench.worlds.scenario_env:ScenarioEnv"
"""Environment of every scenario."""


def register(scenario_id: str, entry_point: str) -> None:
    """Register a scenario with Gymnasium, as a single environment and as a vector environment.

    The scenario is imported and checked when it is first used.

    Args:
        scenario_id: Id of the form "namespace/Name-v0"; a changed scenario gets a new version.
        entry_point: Entry point "module:attribute" of the `Scenario`.

    Raises:
        InputError: The id has another form, is easily mistaken for another, is already registered for another
            entry point, or uses our namespace; or the entry point has another form.
    """
    check_scenario_id(scenario_id)
    if not isinstance(entry_point, str) or not is_entry_point(entry_point):
        raise InputError(
            "The entry point of a scenario must have the form 'package.module:SCENARIO', not "
            f"{entry_point!r}."
        )
    if scenario_id.startswith("clbench/") and not entry_point.startswith(("clbench.", "clbench:")):
        raise InputError(f"{scenario_id!r} is in the namespace of clbench: choose your own.")
    kwargs = {"scenario": entry_point}
    known = gymnasium.registry.get(scenario_id)
    if known is not None and known.kwargs != kwargs:
        raise InputError(
            f"{scenario_id!r} is already registered, with another entry point than {entry_point!r}."
        )
    if known is None:
        registration.register(
            id=scenario_id,
            entry_point=ENVIRONMENT,
            vector_entry_point="clbench.worlds.scenario_vector_env:ScenarioVectorEnv",
            kwargs=kwargs,
        )


def load_scenario(scenario_id: str) -> Scenario:
    """Return the scenario registered with Gymnasium under this id, ready to use.

    Raises:
        UnknownNameError: No scenario is registered under this id.
        MissingPackageError: A package that its tasks need is not installed; the message says how to get it.
        InputError: An instruction is too long or cannot be spelled, or a user's module raises an error.
    """
    return opened_scenario(registered_scenario(scenario_id))


def importable(scenario_id: str) -> str:
    """Return the name by which another process finds a scenario: "module:id" if a user's module registers it.

    Args:
        scenario_id: Registered id, or already "module:id".

    Raises:
        InputError: The scenario is defined in a notebook or script, which other processes cannot import.
    """
    if ":" in scenario_id:
        return scenario_id
    module = gymnasium.registry[scenario_id].kwargs["scenario"].partition(":")[0]
    if module == "__main__":
        raise InputError(
            f"{scenario_id} is defined in a notebook or script, which other processes cannot import: put it "
            "into a module."
        )
    return scenario_id if module.startswith("clbench.envs.") else f"{module}:{scenario_id}"


def registered_scenario(scenario_id: str) -> Scenario:
    """Return the scenario registered with Gymnasium under this id, as data: its packages may be missing.

    Args:
        scenario_id: Gymnasium id; "module:id" imports `module` first.

    Raises:
        UnknownNameError: No scenario is registered under this id.
        InputError: An instruction is too long or cannot be spelled, or a user's module raises an error.
    """
    if not isinstance(scenario_id, str):
        raise WrongTypeError(
            f"The id of a scenario is needed, such as 'clbench/Fetch-v1', not {scenario_id!r:.60}."
        )
    module, _, name = scenario_id.rpartition(":")
    if module:
        import_module(module, scenario_id)
    if name not in gymnasium.registry or "scenario" not in (gymnasium.registry[name].kwargs or {}):
        raise unknown_scenario(scenario_id)
    entry_point = gymnasium.registry[name].kwargs["scenario"]
    scenario = _scenario_at(entry_point)
    if scenario.id != name:
        raise _misnamed(entry_point, name, scenario)
    return scenario


def opened_scenario(scenario: Scenario | str, order: int = 0) -> Scenario:
    """Return a scenario, ready to use, with its targets in the given order.

    Args:
        scenario: Scenario, or its entry point "module:attribute".
        order: Number of the order, see `Scenario.in_order`.

    Raises:
        UnknownNameError: The entry point leads to no scenario, or is registered under another id.
        WrongTypeError: It is neither a scenario nor an entry point.
        MissingPackageError: A package that the tasks need is not installed.
        InputError: There is no such order, or an instruction is too long or cannot be spelled.
    """
    if not isinstance(scenario, Scenario | str):
        raise WrongTypeError(f"A Scenario or its entry point 'module:name' is needed, not {scenario!r}.")
    published = _scenario_at(scenario) if isinstance(scenario, str) else _spelled(scenario)
    published.require_packages()
    return published.in_order(order)


def _scenario_at(entry_point: str) -> Scenario:
    """Return the scenario at an entry point, which must be registered under its own id if under any."""
    scenario = resolve(entry_point)
    if not isinstance(scenario, Scenario):
        raise UnknownNameError(
            f"{entry_point!r} must be a Scenario, not an object of type {type(scenario).__name__}."
        )
    names = [
        name
        for name, spec in gymnasium.registry.items()
        if spec.entry_point == ENVIRONMENT and spec.kwargs.get("scenario") == entry_point
    ]
    if names and scenario.id not in names:
        raise _misnamed(entry_point, names[0], scenario)
    return _spelled(scenario)


def _misnamed(entry_point: str, name: str, scenario: Scenario) -> UnknownNameError:
    return UnknownNameError(f"{entry_point!r} is registered as {name!r}, but its id is {scenario.id!r}.")


def _spelled(scenario: Scenario) -> Scenario:
    """Return a scenario after a check that its instructions can be spelled."""
    from clbench.spec.language import fitting_length  # the tokenizer, which registration does without

    tasks = scenario.tasks + scenario.background
    instructions = tuple(text for task in tasks for text in task.instructions + task.test_instructions)
    fitting_length(instructions)
    _warn_of_spelled_words(scenario.id, instructions)
    return scenario


@functools.cache
def _warn_of_spelled_words(name: str, instructions: tuple[str, ...]) -> None:
    """Warn of words in the instructions of a scenario that look misspelled, once and not in workers."""
    from clbench.spec.language import spelled_words, vocabulary

    if multiprocessing.parent_process() is not None:
        return
    for word in spelled_words(instructions):
        if hint := did_you_mean(word, vocabulary()):
            LOG.warning(
                "%s: the word %r is not in the vocabulary, so the policy reads it in pieces.%s",
                name,
                word,
                hint,
            )
