"""The built-in scenarios, registered with Gymnasium by name; registering imports no simulator."""

from clbench.spec.registry import register

register("clbench/Fetch-v1", "clbench.envs.fetch.scenario:SCENARIO")
register("clbench/FetchKnowledge-v1", "clbench.envs.fetch.scenario:KNOWLEDGE")
register("clbench/FetchPixels-v0", "clbench.envs.fetch_pixels.scenario:SCENARIO")
register("clbench/DMControl-v0", "clbench.envs.dm_control.scenario:SCENARIO")
register("clbench/LiberoGoal-v0", "clbench.envs.libero.scenario:GOAL")
register("clbench/LiberoSpatial-v1", "clbench.envs.libero.scenario:SPATIAL")
register("clbench/MetaWorld-v1", "clbench.envs.metaworld.scenario:SCENARIO")
register("clbench/MetaWorldCW-v0", "clbench.envs.metaworld.scenario:CONTINUAL_WORLD")
register("clbench/PointMaze-v1", "clbench.envs.point_maze.scenario:SCENARIO")
