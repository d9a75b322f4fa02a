"""Stills of the tasks of the project's own scenarios, and of no other file."""

import base64
from pathlib import Path

import pytest

from clbench.base.entry_points import resolve

stills = resolve("clbench.leaderboard.views.page.stills:stills")
film = resolve("clbench.leaderboard.views.page.stills:film")


@pytest.fixture
def cards(tmp_path: Path) -> Path:
    """Return a folder of cards with one still, and a file beside it that is none of theirs."""
    (tmp_path / "Toy-v0").mkdir()
    (tmp_path / "Toy-v0" / "lift.webp").write_bytes(b"a still")
    (tmp_path / "secret.webp").write_bytes(b"a secret")
    return tmp_path


def test_a_task_with_a_picture_has_a_still(cards: Path) -> None:
    found = stills("clbench/Toy-v0", ["lift", "press"], cards)
    assert list(found) == ["lift"]
    head, _, content = found["lift"].partition(",")
    assert head == "data:image/webp;base64"
    assert base64.b64decode(content) == b"a still"


def test_another_policy_does_the_same_tasks(cards: Path) -> None:
    assert stills("clbench/Toy-v0+discrete_diffusion", ["lift"], cards)


def test_a_scenario_with_a_film_has_it_for_the_default_policy(cards: Path) -> None:
    assert film("clbench/Toy-v0", cards) is None
    (cards / "Toy-v0" / "film.gif").write_bytes(b"a film")
    assert film("clbench/Toy-v0", cards) == "data:image/gif;base64," + base64.b64encode(b"a film").decode()
    assert film("clbench/Toy-v0+discrete_diffusion", cards) is None


def test_names_of_strangers_lead_to_no_file(cards: Path) -> None:
    assert not stills("clbench/Toy-v0", ["../secret", "lift.webp", "", "lift\n"], cards)
    assert not stills("other/Toy-v0", ["lift"], cards)
    assert not stills("clbench/..", ["secret"], cards)


def test_an_installed_wheel_without_cards_has_no_stills(tmp_path: Path) -> None:
    assert not stills("clbench/Toy-v0", ["lift"], tmp_path / "missing")


def test_the_main_scenario_has_a_still_of_each_task() -> None:
    tasks = ["reach", "hover", "pick_and_place", "push_right", "press", "lift", "carry_back"]
    assert list(stills("clbench/Fetch-v1", tasks)) == tasks
