"""The package as a whole: its front door, the effects of its import, and its files."""

import dataclasses
import pydoc
import re

import pytest
from helpers import output_of

import clbench
from clbench.base.entry_points import resolve


def test_every_public_name_can_be_imported() -> None:
    assert len(clbench.__all__) == 53
    for name in clbench.__all__:
        assert getattr(clbench, name).__name__.rpartition(".")[2] == name


def test_help_shows_every_field_of_a_public_class_with_its_docstring() -> None:
    classes = [value for name in clbench.__all__ if dataclasses.is_dataclass(value := getattr(clbench, name))]
    assert len(classes) >= 15
    for cls in classes:
        shown = pydoc.plain(pydoc.render_doc(cls))
        for field in dataclasses.fields(cls):
            assert re.search(rf"^ \|      {field.name}: [A-Z0-9]", shown, re.MULTILINE), (cls, field.name)
        assert shown.count("Attributes:") == 1


def test_an_unknown_name_is_an_attribute_error() -> None:
    assert not hasattr(clbench, "no_such_name")


def test_importing_registers_the_scenarios_and_loads_nothing_heavy() -> None:
    heavy = "{'torch', 'mujoco', 'pandas', 'minari', 'gymnasium_robotics', 'psutil', 'rich'}"
    code = "import clbench, gymnasium, sys; gymnasium.spec('clbench/Fetch-v1');"
    assert output_of(f"{code} print({heavy} & set(sys.modules))") == "set()"


def test_the_help_of_run_and_the_driver_of_ray_jobs_do_not_wait_for_pytorch() -> None:
    code = "import clbench.cli.main, clbench.cli.runs, clbench.jobs.ray, clbench.runs.spec, sys;"
    assert output_of(f"{code} print('torch' in sys.modules)") == "False"


@pytest.mark.long
def test_nothing_leaks_to_the_top_level() -> None:
    code = "import clbench.cli.main, clbench.methods.sft, clbench.envs.fetch, clbench.leaderboard, sys;"
    code += "print({'envs', 'methods', 'leaderboard'} & set(sys.modules))"
    assert output_of(code) == "set()"


def test_the_records_of_the_board_come_with_clbench() -> None:
    published = resolve("clbench.leaderboard.publishing:PUBLISHED")
    assert len(list((published / "Fetch-v1").rglob("seed-*.json"))) >= 88
    tied = published.parent / "ladder" / "Fetch-v1" / "sft+step_factor=0.1"
    assert len(list(tied.glob("seed-*.json"))) == 12  # without them, no gain over sft is certain


def test_the_pictures_of_the_scenario_cards_come_with_clbench() -> None:
    module = "clbench.leaderboard.views.page.stills"
    stills, film = resolve(f"{module}:stills"), resolve(f"{module}:film")
    for name in ("clbench/Fetch-v1", "clbench/MetaWorld-v1", "clbench/PointMaze-v1"):  # they need no extra
        tasks = [task.name for task in clbench.load_scenario(name).tasks]
        assert list(stills(name, tasks)) == tasks
    assert film("clbench/Fetch-v1").startswith("data:image/gif")
