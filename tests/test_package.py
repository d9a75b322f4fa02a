"""The package as a whole: its front door, the effects of its import, and its files."""

import subprocess
import sys

import clbench


def _run(code: str) -> str:
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return result.stdout.strip()


def test_every_public_name_can_be_imported() -> None:
    assert len(clbench.__all__) == 33
    for name in clbench.__all__:
        assert getattr(clbench, name).__name__ == name


def test_an_unknown_name_is_an_attribute_error() -> None:
    assert not hasattr(clbench, "no_such_name")


def test_importing_registers_the_scenarios_and_loads_nothing_heavy() -> None:
    heavy = "{'torch', 'mujoco', 'pandas', 'minari', 'gymnasium_robotics', 'psutil', 'rich'}"
    code = "import clbench, gymnasium, sys; gymnasium.spec('clbench/Fetch-v1');"
    assert _run(f"{code} print({heavy} & set(sys.modules))") == "set()"


def test_the_help_of_run_and_the_driver_of_ray_jobs_do_not_wait_for_pytorch() -> None:
    code = "import clbench.cli.main, clbench.cli.runs, clbench.jobs.ray, clbench.runs.spec, sys;"
    assert _run(f"{code} print('torch' in sys.modules)") == "False"


def test_nothing_leaks_to_the_top_level() -> None:
    code = "import clbench.cli.main, clbench.methods.sft, clbench.envs.fetch, clbench.leaderboard, sys;"
    code += "print({'envs', 'methods', 'leaderboard'} & set(sys.modules))"
    assert _run(code) == "set()"
