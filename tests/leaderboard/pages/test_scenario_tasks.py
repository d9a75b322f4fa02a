"""The tasks on a scenario's card: some have no expert, and the worlds of some cannot be drawn."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import gymnasium
import pytest
from gymnasium.envs.registration import EnvSpec

from clbench.base.entry_points import resolve
from clbench.testing import TOY, ToyWorld

scenario_card = resolve("clbench.leaderboard.pages.cli:scenario_card")


class Unlit(ToyWorld):
    """It cannot be drawn."""


LAST = TOY.held_out[0]
RECORDED = dataclasses.replace(
    TOY,
    id="me/Recorded-v0",
    held_out=(dataclasses.replace(LAST, expert="clbench.exchange.recorded:demonstrations_0123456789abcdef"),),
)
UNLIT = dataclasses.replace(
    TOY, id="me/Unlit-v0", held_out=(dataclasses.replace(LAST, world=f"{__name__}:Unlit"),)
)
BOTH = dataclasses.replace(
    RECORDED,
    id="me/Both-v0",
    held_out=(dataclasses.replace(RECORDED.held_out[0], world=f"{__name__}:Unlit"),),
)


@pytest.fixture
def cards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return a function that writes the cards of scenarios, and returns all their text."""
    monkeypatch.setenv("MUJOCO_GL", "egl")  # the choice ends with the test
    monkeypatch.setattr(
        "clbench.worlds.gl_backend.rendering_fault",
        lambda _, world=None: "it is dark" if world == f"{__name__}:Unlit" else None,
    )
    for name, scenario in (("RECORDED", RECORDED), ("UNLIT", UNLIT), ("BOTH", BOTH)):
        spec = EnvSpec(scenario.id, kwargs={"scenario": f"{__name__}:{name}"})
        monkeypatch.setitem(gymnasium.registry, scenario.id, spec)

    def write(*scenarios: str) -> str:
        scenario_card(*scenarios, episodes=2, records=tmp_path / "records", output=tmp_path)
        return "".join(path.read_text(encoding="utf-8") for path in tmp_path.glob("*.md"))

    return write


def test_a_task_that_learns_from_a_recording_is_on_the_card_without_an_expert(
    cards: Callable[..., str],
) -> None:
    card = cards(RECORDED.id).replace("\\", "")
    row = next(line for line in card.splitlines() if line.startswith(f"| {LAST.name} | - |"))
    assert row.endswith(f"| - | {LAST.horizon} |")
    assert f"Without an expert and a picture: {LAST.name}. Their demonstrations are recorded." in card
    assert "Without a picture" not in card


def test_a_world_that_cannot_be_drawn_takes_no_picture_from_another_scenario(
    cards: Callable[..., str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cards(UNLIT.id, TOY.id)
    assert {path.stem for path in (tmp_path / "Toy-v0").glob("*.webp")} == {task.name for task in TOY.tasks}
    assert not [*(tmp_path / "me--Unlit-v0").glob("*.webp")]
    assert "me/Unlit-v0: No pictures are drawn" in capsys.readouterr().err


def test_a_renderer_that_draws_all_scenarios_is_preferred_to_the_first_one_of_some(
    cards: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setattr("clbench.worlds.gl_backend._BACK_ENDS", ("egl", "osmesa"))
    monkeypatch.setattr(
        "clbench.worlds.gl_backend.rendering_fault",
        lambda back_end, world=None: (
            "it is dark" if (back_end, world) == ("egl", f"{__name__}:Unlit") else None
        ),
    )
    cards(TOY.id, UNLIT.id)
    assert {path.stem for path in (tmp_path / "me--Unlit-v0").glob("*.webp")} == {
        task.name for task in UNLIT.tasks
    }


def test_a_recorded_task_needs_no_renderer(
    cards: Callable[..., str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cards(BOTH.id)
    drawn = {task.name for task in BOTH.tasks} - {LAST.name}
    assert {path.stem for path in (tmp_path / "me--Both-v0").glob("*.webp")} == drawn
    assert "No pictures are drawn" not in capsys.readouterr().err
