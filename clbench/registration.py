"""Registration: a scenario gets its Gymnasium id, by name alone: nothing of it is imported."""

from __future__ import annotations

import gymnasium
from gymnasium.envs import registration

from clbench.names import check_scenario_id


def register(scenario_id: str, entry_point: str) -> None:
    """Register a scenario with Gymnasium, as one environment and as many side by side.

    It is imported, and its parts are checked, when it is first used.

    Args:
        scenario_id: Of the form "namespace/Name-v0": a changed scenario is a new version.
        entry_point: Where the `Scenario` is, as "module:attribute".

    Raises:
        ValueError: The id is of another form, can be taken for another scenario, is registered already for
            another one, or is in our namespace; or the entry point is of another form.
    """
    check_scenario_id(scenario_id)
    module, colon, attribute = entry_point.partition(":")
    if not (colon and attribute.isidentifier() and all(map(str.isidentifier, module.split(".")))):
        raise ValueError(f"{entry_point!r} must be the place of a scenario, as 'package.module:SCENARIO'.")
    if scenario_id.startswith("clbench/") and module.partition(".")[0] != "clbench":
        raise ValueError(f"{scenario_id!r} is in the namespace of clbench: choose your own.")
    kwargs = {"scenario": entry_point}
    known = gymnasium.registry.get(scenario_id)
    if known is not None and known.kwargs != kwargs:
        raise ValueError(f"{scenario_id!r} is registered already, and not for {entry_point!r}.")
    if known is None:
        registration.register(
            id=scenario_id,
            entry_point="clbench.scenario_env:ScenarioEnv",
            vector_entry_point="clbench.scenario_vector_env:ScenarioVectorEnv",
            kwargs=kwargs,
        )
