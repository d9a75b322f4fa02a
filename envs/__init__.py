"""The scenarios, registered with Gymnasium by name: nothing of a simulator is imported here."""

from clbench.spec.registry import register

register("clbench/Fetch-v0", "clbench.envs.fetch:SCENARIO")
register("clbench/FetchPixels-v0", "clbench.envs.fetch.pixels:SCENARIO")
register("clbench/DMControl-v0", "clbench.envs.dm_control:SCENARIO")
register("clbench/MetaWorld-v0", "clbench.envs.metaworld:SCENARIO")
register("clbench/MetaWorldCW-v0", "clbench.envs.metaworld:CONTINUAL_WORLD")
register("clbench/PointMaze-v0", "clbench.envs.point_maze:SCENARIO")
