"""What the numbers of a state mean, from the module `state` beside a stranger's world."""

import dataclasses
from pathlib import Path

import pytest

from clbench.base.entry_points import resolve
from clbench.testing import TOY

spaces_of = resolve("clbench.leaderboard.pages.scenario_spaces:spaces_of")

WORLD = """
from clbench.testing import ToyWorld
class World(ToyWorld): ...
"""
STATE = '''"""Where the point is and was."""
LAST = slice(-1, None)
"""Time."""
PLACE = slice(2)
"""Place."""
'''
LONGER = STATE + 'OTHERS = slice(4, 9)\n"""Other points."""\n'


def parts_with(state: str, package: Path) -> tuple[tuple[str, str], ...]:
    """Return what the numbers of a state mean, by the module `state` of a new package."""
    package.mkdir()
    for name, text in (("__init__", ""), ("world", WORLD), ("state", state)):
        (package / f"{name}.py").write_text(text, encoding="utf-8")
    first = dataclasses.replace(TOY.retained[0], world=f"{package.name}.world:World")
    found: tuple[tuple[str, str], ...] = spaces_of(
        dataclasses.replace(TOY, retained=(first, *TOY.retained[1:]))
    ).parts
    return found


def test_the_slices_of_a_state_may_have_open_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    found = parts_with(STATE, tmp_path / "open_ended")
    assert found == (("0 to 1", "Place."), ("3 to 3", "Time."))


def test_a_layout_that_is_longer_than_the_state_belongs_to_another_world(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    assert parts_with(LONGER, tmp_path / "of_another") == ()
