"""Pictures of demonstrations: their episodes are played again, and drawn as `clbench score` draws them."""

import dataclasses
import io
import json
from contextlib import closing
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as parquet
import pytest
from helpers import scenario_or_skip
from PIL import Image

from clbench import export_demonstrations
from clbench.base.errors import InputError, UnknownNameError
from clbench.data.demonstrations import collect, dataset_folder, has_dataset, read_dataset
from clbench.evaluation.views import SimulatorCameras
from clbench.exchange.recorded import expert_of
from clbench.exchange.replayed import drawn
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.worlds.lanes import Lanes

CAMERAS = ("external_camera_0", "gripper_camera_rgb")
SIZE = 24


def _small(scenario: Scenario, count: int = 2) -> Scenario:
    """Return the scenario with few demonstrations for each task."""
    return dataclasses.replace(
        scenario, budget=dataclasses.replace(scenario.budget, demonstrations=count, noisy_demonstrations=1.0)
    )


FETCH = _small(load_scenario("clbench/Fetch-v1"))
TASK = FETCH.task("press")


class Blind:
    """Cameras that draw nothing."""

    names = ("front",)

    def draw(self, lanes: Lanes, lane: int, task: object) -> dict[str, Any]:
        """Return a picture of one pixel."""
        return {"front": np.zeros((1, 1, 3), np.uint8)}


@pytest.fixture(scope="module")
def pictures() -> list[dict[str, Any]]:
    """The pictures of the demonstrations, drawn by hand from the seeds and the executed actions."""
    found = []
    with closing(SimulatorCameras(CAMERAS, SIZE)) as cameras, closing(Lanes(1)) as lanes:
        for episode in read_dataset(dataset_folder(TASK, FETCH.budget)):
            assert episode.seed is not None
            lanes.reset([0], [episode.seed], [TASK])
            steps = []
            for action in episode.executed:
                steps.append(cameras.draw(lanes, 0, TASK))
                lanes.step([0], action[None])
            found.append({name: np.stack([step[name] for step in steps]) for name in CAMERAS})
    return found


def _export(folder: Path, kind: Any, scenario: Scenario = FETCH, **options: Any) -> Path:
    chosen = {"tasks": ["press"], "pictures": CAMERAS, "picture_size": SIZE, **options}
    return export_demonstrations(scenario, folder, format=kind, **chosen)


@pytest.mark.parametrize(
    "name",
    [
        "clbench/DMControl-v0",
        "clbench/Fetch-v1",
        "clbench/FetchPixels-v0",
        pytest.param("clbench/LiberoGoal-v0", marks=pytest.mark.long),
        "clbench/MetaWorld-v1",
        "clbench/PointMaze-v1",
    ],
)
def test_every_suite_plays_its_demonstrations_again_bit_for_bit(name: str) -> None:
    scenario = _small(scenario_or_skip(name), 1)
    task = scenario.target[0]
    episodes = collect(task, scenario.budget)
    (found,) = drawn(task, episodes, Blind())  # type: ignore[arg-type]
    assert len(found["front"]) == len(episodes[0].executed)


def test_a_lerobot_dataset_has_a_picture_of_each_camera_before_each_step(
    tmp_path: Path, pictures: list[dict[str, Any]]
) -> None:
    shares: list[float] = []
    folder = _export(tmp_path / "out", "lerobot", progress=shares.append)
    assert shares == [0.5, 0.5]
    table = parquet.read_table(next((folder / "data").rglob("*.parquet")))
    features = json.loads((folder / "meta" / "info.json").read_text())["features"]
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    assert "observation.environment_state" not in features
    for camera in CAMERAS:
        name = f"observation.images.{camera}"
        assert (features[name]["dtype"], features[name]["shape"]) == ("image", [SIZE, SIZE, 3])
        cells = table.column(name).to_pylist()
        found = np.stack([np.array(Image.open(io.BytesIO(cell["bytes"]))) for cell in cells])
        expected = np.concatenate([episode[camera] for episode in pictures])
        assert np.array_equal(found, expected)
        assert np.allclose(np.ravel(stats[name]["mean"]), expected.reshape(-1, 3).mean(0) / 255)
        assert stats[name]["count"] == [len(expected)]


def test_an_hdf5_file_has_the_names_of_robomimic(tmp_path: Path, pictures: list[dict[str, Any]]) -> None:
    folder = _export(tmp_path / "out", "hdf5")
    with h5py.File(folder / "press_demo.hdf5") as file:
        for number, expected in enumerate(pictures):
            for camera in CAMERAS:
                assert np.array_equal(file[f"data/demo_{number}/obs/{camera}_image"], expected[camera])


def test_an_episode_that_was_left_out_changes_no_other(
    tmp_path: Path, pictures: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "clbench.exchange.demonstrations.read_dataset", lambda folder: read_dataset(folder)[1:]
    )
    folder = _export(tmp_path / "out", "hdf5")
    with h5py.File(folder / "press_demo.hdf5") as file:
        assert list(file["data"]) == ["demo_0"]
        found = file[f"data/demo_0/obs/{CAMERAS[0]}_image"]
        assert np.array_equal(found, pictures[1][CAMERAS[0]])


@pytest.mark.parametrize(("step", "place"), [(0, 0), (3, 3)])
def test_a_demonstration_that_this_machine_does_not_repeat_is_named(step: int, place: int) -> None:
    first, second = read_dataset(dataset_folder(TASK, FETCH.budget))
    changed = second.state.copy()
    changed[place] = np.nextafter(changed[place], np.float32(np.inf))
    episodes = [first, dataclasses.replace(second, state=changed)]
    with pytest.raises(InputError, match=rf"Demonstration 1 of press cannot be drawn: .* at step {step}\."):
        list(drawn(TASK, episodes, Blind()))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"pictures": ["external_camera"]},
            UnknownNameError,
            "camera in the scenes .*Did you mean 'external_camera_0'",
        ),
        ({"picture_size": 481}, InputError, "at most 480 pixels, not 481"),
        ({"pictures": CAMERAS[:1] * 2}, InputError, "each named once"),
    ],
)
def test_pictures_that_cannot_be_drawn_are_refused_before_any_demonstration_is_collected(
    options: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    other = _small(FETCH, 3)
    with pytest.raises(error, match=message):
        _export(tmp_path / "out", "lerobot", other, **options)
    assert not has_dataset(TASK, other.budget)
    assert list(tmp_path.iterdir()) == []


def test_demonstrations_that_were_recorded_elsewhere_have_no_pictures(tmp_path: Path) -> None:
    task = dataclasses.replace(TASK, expert=expert_of("0123456789abcdef"))
    others = tuple(one for one in FETCH.target if one.name != task.name)
    scenario = dataclasses.replace(FETCH, target=(task, *others))
    with pytest.raises(InputError, match=r"demonstrations of press have no pictures .* recorded elsewhere"):
        _export(tmp_path / "out", "lerobot", scenario)
    assert list(tmp_path.iterdir()) == []
