"""The worked example of `docs/guide/your_scenario.md`, run unchanged, as a stranger would."""

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from helpers import blocks_of

from clbench.records.reader import read_record
from clbench.scoring.scores import Scores

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "your_scenario.md"


def _python(folder: Path, *arguments: str) -> str:
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]),
    }
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory that holds the package of the page."""
    folder = tmp_path_factory.mktemp("stranger")
    (folder / "mypackage.py").write_text(blocks_of(PAGE, "python")[0], encoding="utf-8")
    return folder


@pytest.mark.long
def test_its_scenario_is_an_environment_and_passes_the_check(folder: Path) -> None:
    _, environments, check = blocks_of(PAGE, "python")
    shown = "\nprint(env.unwrapped.scenario.id, envs.reset(seed=0)[0]['state'].shape)"
    assert _python(folder, "-c", environments + check + shown) == "me/Mine-v0 (4, 4)\n"


@pytest.mark.long
def test_its_world_is_perturbed_as_the_page_shows(tmp_path: Path) -> None:
    """Insert the lines of the page into the world, each before or after a line that occurs once."""
    imported, declared, made, drawn, displaced = _fragments()
    world = blocks_of(PAGE, "python")[0].replace("render_mode=None", "render_mode=None, perturbed=False")
    for line, lines in (
        ("import clbench\n", f"import clbench\n{imported}\n"),
        ("    def __init__(", f"{declared}\n\n    def __init__("),
        ("self.data = mujoco.MjData(self.model)\n", f"self.data = mujoco.MjData(self.model)\n{made}\n"),
        ("        mujoco.mj_resetData", f"{drawn}\n        mujoco.mj_resetData"),
        ("        return self._state(), {", f"{displaced}\n        return self._state(), {{"),
    ):
        assert world.count(line) == 1
        world = world.replace(line, lines)
    (tmp_path / "mypackage.py").write_text(world, encoding="utf-8")
    _python(tmp_path, "-c", LOOK_AT_IT)


LOOK_AT_IT = """
import mypackage
from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.lanes import check_perturbable

check_perturbable(mypackage.SCENARIO.retained)
plain, perturbed = mypackage.Table(), mypackage.Table(perturbed=True)
for seed in range(4):
    drawn = draw_perturbation(seed)
    one, other = (world.reset(seed=seed)[0] for world in (plain, perturbed))
    assert abs(other[:2] - one[:2] - 0.05 * mypackage.np.array(drawn.start[:2])).max() < 1e-6
    assert perturbed.model.body("ball").mass == drawn.mass * plain.model.body("ball").mass
"""


def _fragments() -> list[str]:
    """Return the lines that the page adds to a perturbable world: an import, and lines for four places."""
    (block,) = re.findall(r"  ```py\n(.*?)  ```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    first, declared, *others = textwrap.dedent(block).strip("\n").split("\n\n")
    return [first, textwrap.indent(declared, " " * 4), *(textwrap.indent(lines, " " * 8) for lines in others)]


@pytest.mark.slow
def test_its_commands_make_a_row_with_skills_that_are_forgotten(folder: Path) -> None:
    for line in blocks_of(PAGE, "console")[0].strip().splitlines():
        printed = _python(folder, "-m", *line.split())
    assert "me/Mine-v0" in printed
    scores = Scores.from_record(read_record(folder / "leaderboard/records/me--Mine-v0/sft/seed-0.json"))
    learned = scores.rates().learned.mean()
    before, after = scores.rates().retained[[0, -1]].mean(axis=-1)
    assert (before > 0.5, learned > 0.5, after < before) == (True, True, True), (before, learned, after)
