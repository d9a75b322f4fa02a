"""The scenarios, registered with Gymnasium by name: nothing of a simulator is imported here."""

from gymnasium.envs.registration import register

register(
    id="clbench/Fetch-v0",
    entry_point="clbench.scenario_env:ScenarioEnv",
    vector_entry_point="clbench.scenario_vector_env:ScenarioVectorEnv",
    kwargs={"scenario": "clbench.envs.fetch:SCENARIO"},
)

register(
    id="clbench/MetaWorld-v0",
    entry_point="clbench.scenario_env:ScenarioEnv",
    vector_entry_point="clbench.scenario_vector_env:ScenarioVectorEnv",
    kwargs={"scenario": "clbench.envs.metaworld:SCENARIO"},
)

register(
    id="clbench/MetaWorldCW-v0",
    entry_point="clbench.scenario_env:ScenarioEnv",
    vector_entry_point="clbench.scenario_vector_env:ScenarioVectorEnv",
    kwargs={"scenario": "clbench.envs.metaworld:CONTINUAL_WORLD"},
)

register(
    id="clbench/PointMaze-v0",
    entry_point="clbench.scenario_env:ScenarioEnv",
    vector_entry_point="clbench.scenario_vector_env:ScenarioVectorEnv",
    kwargs={"scenario": "clbench.envs.point_maze:SCENARIO"},
)
