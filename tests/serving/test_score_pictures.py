"""Pictures for policies that were fine-tuned elsewhere: of each episode, and the same in all stages."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agents import ID

from clbench.base.errors import InputError
from clbench.evaluation.views import SimulatorCameras
from clbench.records.record import Record
from clbench.serving.score import is_scored


def idle(observations: dict[str, Any]) -> Any:
    """Return chunks of one action that does nothing."""
    return np.zeros((len(observations["state"]), 1, 2))


def _drawn(self: SimulatorCameras, lanes: Any, lane: int, task: Any) -> dict[str, Any]:
    """Return pictures that show which camera drew which lane."""
    shape = (self.size, self.size, 3)
    return {name: np.full(shape, 100 * number + lane, np.uint8) for number, name in enumerate(self.names)}


def test_a_policy_gets_the_pictures_of_each_episode_and_the_record_keeps_which(
    run: Callable[..., Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SimulatorCameras, "check", lambda *_: None)
    monkeypatch.setattr(SimulatorCameras, "draw", _drawn)
    seen: list[dict[str, Any]] = []
    closed: list[tuple[str, ...]] = []
    monkeypatch.setattr(SimulatorCameras, "close", lambda cameras: closed.append(cameras.names))

    def act(observations: dict[str, Any]) -> Any:
        seen.append(observations)
        return np.zeros((len(observations["state"]), 2, 2))

    record = run(act, 0, pictures=["front", "wrist"], picture_size=8)
    assert record.run.settings == {"executed": 2, "pictures": ["front", "wrist"], "picture_size": 8}
    for number, name in enumerate(("front", "wrist")):
        pictures = seen[0][f"pictures/{name}"]
        assert (pictures.shape, pictures.dtype) == ((40, 8, 8, 3), np.uint8)
        rows = pictures[:, 0, 0, 0] - 100 * number
        running = len({*rows.tolist()})
        assert len({*rows[:running].tolist()}) == running
        assert {*rows[running:].tolist()} <= {rows[0]}  # unused rows
    assert closed == [("front", "wrist")]
    run(act, 0, method="me/blind")
    assert "pictures/front" not in seen[-1]


def test_all_stages_have_the_same_pictures(
    run: Callable[..., Record], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SimulatorCameras, "check", lambda *_: None)
    monkeypatch.setattr(SimulatorCameras, "draw", _drawn)
    run(idle, 0, pictures=["front"], picture_size=8)
    for other in ({}, {"pictures": ["wrist"], "picture_size": 8}, {"pictures": ["front"]}):
        with pytest.raises(InputError, match=r"The settings of .* but were .*'pictures': \['front'\]"):
            run(idle, 1, **other)
    record = run(idle, 1, pictures=["front"], picture_size=8)
    assert record.run.settings == {"executed": 1, "pictures": ["front"], "picture_size": 8}
    options: dict[str, Any] = {"stage": 1, "method": "me/elsewhere", "records": tmp_path / "records"}
    assert is_scored(ID, **options, pictures=["front"], picture_size=8)
    with pytest.raises(InputError, match=r"scored with pictures \['front'\], not \['wrist'\]"):
        is_scored(ID, **options, pictures=["wrist"], picture_size=8)


def test_a_run_may_start_over_with_other_pictures_and_older_stages_have_none(
    run: Callable[..., Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SimulatorCameras, "check", lambda *_: None)
    monkeypatch.setattr(SimulatorCameras, "draw", _drawn)
    run(idle, 0)
    with pytest.raises(
        InputError, match=r"are .*'pictures': \['front'\].*, but were {'executed': 1} in stage 0"
    ):
        run(idle, 1, pictures=["front"])
    record = run(idle, 0, pictures=["front"], picture_size=8, restart=True)
    assert record.run.settings == {"executed": 1, "pictures": ["front"], "picture_size": 8}
    again = run(idle, 0, restart=True)
    assert again.run.settings == {"executed": 1}
