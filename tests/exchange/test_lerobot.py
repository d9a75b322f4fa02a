"""Export as a LeRobotDataset, read back as its files are, and judged by lerobot-doctor."""

import dataclasses
import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
import pytest

from clbench import export_demonstrations
from clbench.base.errors import InputError, MissingPackageError
from clbench.data.demonstrations import Demonstration, dataset_folder, read_dataset
from clbench.exchange.lerobot import write_lerobot
from clbench.spec.scenario import Scenario
from clbench.testing import TOY, ToyWorld
from clbench.worlds.observation import observed

CAMERA = "clbench.testing.toy_camera:ToyCamera"


def _seen(scenario: Scenario = TOY) -> Scenario:
    """Return the toy with a camera."""
    retained = tuple(dataclasses.replace(task, camera=CAMERA) for task in scenario.retained)
    return dataclasses.replace(scenario, retained=retained, target=(), held_out=())


def _rows(path: Path) -> dict[str, Any]:
    return {name: column.to_numpy() for name, column in zip(*_table(path), strict=True)}


def _table(path: Path) -> tuple[list[str], list[Any]]:
    table = parquet.read_table(path)
    return table.column_names, table.columns


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The retained skills and the targets of the toy as a LeRobotDataset."""
    return export_demonstrations(TOY, tmp_path_factory.mktemp("out") / "toy", format="lerobot")


@pytest.fixture(scope="module")
def episodes() -> list[Demonstration]:
    """The demonstrations of the same tasks."""
    tasks = (*TOY.retained, *TOY.target)
    return [episode for task in tasks for episode in read_dataset(dataset_folder(task, TOY.budget))]


def _info(folder: Path) -> dict[str, Any]:
    info: dict[str, Any] = json.loads((folder / "meta" / "info.json").read_text())
    return info


def test_it_has_the_files_of_version_3(folder: Path, episodes: list[Demonstration]) -> None:
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert files == {
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    }
    info = _info(folder)
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_episodes"], info["total_tasks"]) == (10, 40, 8)
    assert info["total_frames"] == sum(len(episode.executed) for episode in episodes)
    assert info["splits"] == {"train": "0:40"}
    for place in (info["data_path"], "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"):
        assert (folder / place.format(chunk_index=0, file_index=0)).is_file()


def test_its_frames_are_those_of_the_demonstrations_bit_for_bit(
    folder: Path, episodes: list[Demonstration]
) -> None:
    rows = _rows(folder / "data" / "chunk-000" / "file-000.parquet")
    expected: dict[str, list[Any]] = {
        "observation.state": [episode.state[:-1] for episode in episodes],
        "observation.environment_state": [episode.state[:-1] for episode in episodes],
        "action": [episode.expert[:-1] for episode in episodes],
        "executed": [episode.executed for episode in episodes],
        "noisy": [episode.noisy[:-1] for episode in episodes],
        "next.reward": [episode.reward for episode in episodes],
    }
    for name, parts in expected.items():
        found, whole = np.stack(list(rows[name])), np.concatenate(parts)
        assert (found.dtype, found.shape, found.tobytes()) == (whole.dtype, whole.shape, whole.tobytes())
    lengths = [len(episode.executed) for episode in episodes]
    frames = np.concatenate([np.arange(length) for length in lengths])
    assert np.array_equal(rows["frame_index"], frames)
    assert np.array_equal(rows["timestamp"], (frames / 10).astype(np.float32))
    assert np.array_equal(rows["episode_index"], np.repeat(np.arange(40), lengths))
    assert np.array_equal(rows["index"], np.arange(sum(lengths)))
    ends = np.flatnonzero(rows["next.done"])
    assert np.array_equal(ends, np.cumsum(lengths) - 1)
    assert rows["next.success"][ends].all()


def test_its_columns_are_those_that_info_declares(folder: Path) -> None:
    features = _info(folder)["features"]
    schema = parquet.read_schema(folder / "data" / "chunk-000" / "file-000.parquet")
    assert schema.names == list(features)
    for name, feature in features.items():
        kind, (width,) = schema.field(name).type, feature["shape"]
        assert width == (1 if not hasattr(kind, "list_size") else kind.list_size)
    assert features["action"] == {"dtype": "float32", "shape": [2], "names": None}


def test_the_episodes_of_a_task_have_its_wordings_in_turn(folder: Path) -> None:
    tasks = parquet.read_table(folder / "meta" / "tasks.parquet").to_pandas()
    assert list(tasks.index[:3]) == ["go left", "move to the left", "go up"]
    assert list(tasks.task_index) == list(range(8))
    facts = parquet.read_table(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert [fact["tasks"] for fact in facts[8:12]] == [
        ["go left"],
        ["move to the left"],
        ["go up"],
        ["move up"],
    ]
    rows = _rows(folder / "data" / "chunk-000" / "file-000.parquet")
    for fact in facts:
        frames = slice(fact["dataset_from_index"], fact["dataset_to_index"])
        assert set(rows["episode_index"][frames]) == {fact["episode_index"]}
        assert fact["length"] == frames.stop - frames.start
        assert {tasks.index[number] for number in rows["task_index"][frames]} == set(fact["tasks"])


def test_tasks_with_the_same_instruction_share_its_entry(tmp_path: Path) -> None:
    left, up = TOY.retained
    found = {
        left: read_dataset(dataset_folder(left, TOY.budget)),
        dataclasses.replace(up, instructions=left.instructions): read_dataset(dataset_folder(up, TOY.budget)),
    }
    write_lerobot(tmp_path, found)
    tasks = parquet.read_table(tmp_path / "meta" / "tasks.parquet").to_pandas()
    assert list(tasks.index) == ["go left", "move to the left"]
    assert _info(tmp_path)["total_tasks"] == 2
    rows = _rows(tmp_path / "data" / "chunk-000" / "file-000.parquet")
    assert set(rows["task_index"]) == {0, 1}


def test_its_statistics_are_those_of_its_frames(folder: Path) -> None:
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    rows = _rows(folder / "data" / "chunk-000" / "file-000.parquet")
    assert set(stats) == set(rows)
    states = np.stack(list(rows["observation.state"])).astype(np.float64)
    for name, value in (
        ("min", states.min(0)),
        ("max", states.max(0)),
        ("mean", states.mean(0)),
        ("std", states.std(0)),
        ("q10", np.quantile(states, 0.1, axis=0)),
        ("count", [len(states)]),
    ):
        assert np.allclose(stats["observation.state"][name], value)
    facts = parquet.read_table(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    first = states[: facts[0]["length"]]
    assert np.allclose(facts[0]["stats/observation.state/max"], first.max(0))
    assert facts[0]["stats/observation.state/count"] == [len(first)]


@pytest.mark.long
def test_pictures_are_kept_without_loss(tmp_path: Path) -> None:
    import io

    from PIL import Image

    seen = _seen()
    folder = export_demonstrations(seen, tmp_path / "seen", format="lerobot")
    features = _info(folder)["features"]
    assert features["observation.state"]["shape"] == [1]
    assert features["observation.images.image"]["dtype"] == "image"
    assert features["observation.images.image"]["shape"] == [16, 16, 3]
    assert "observation.environment_state" not in features
    table = parquet.read_table(folder / "data" / "chunk-000" / "file-000.parquet")
    pictures = [
        np.array(Image.open(io.BytesIO(one["bytes"])))
        for one in table.column("observation.images.image").to_pylist()
    ]
    found = [read_dataset(dataset_folder(task, seen.budget)) for task in seen.retained]
    states = np.concatenate([episode.state[:-1] for part in found for episode in part])
    numbers, images = observed(seen.retained[0], states)
    assert np.array_equal(np.stack(pictures), images)
    assert np.array_equal(table.column("observation.state").to_numpy(), numbers[:, 0])
    stats = json.loads((folder / "meta" / "stats.json").read_text())["observation.images.image"]
    colours = images.reshape(-1, 3) / 255
    expected = {"min": colours.min(0), "max": colours.max(0), "mean": colours.mean(0), "std": colours.std(0)}
    expected |= {
        f"q{100 * share:02.0f}": np.quantile(colours, share, axis=0) for share in (0.01, 0.1, 0.5, 0.9, 0.99)
    }
    for name, value in expected.items():
        assert np.allclose(np.array(stats[name])[:, 0, 0], value), name


@pytest.mark.long
@pytest.mark.skipif(find_spec("lerobot_doctor") is None, reason="lerobot-doctor is not installed")
@pytest.mark.parametrize("scenario", [TOY, _seen()], ids=["numbers", "pictures"])
def test_lerobot_doctor_finds_no_fault(scenario: Scenario, tmp_path: Path) -> None:
    folder = export_demonstrations(scenario, tmp_path / "out", format="lerobot")
    code = f"from lerobot_doctor.cli import main; main(['check', {str(folder)!r}, '--ci'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    found = {check["name"]: check["severity"] for check in report["checks"]}
    assert "FAIL" not in found.values()
    form = ("Metadata & Format Compliance", "Temporal Consistency", "Feature Consistency", "Portability")
    assert {found[name] for name in form} == {"PASS"}
    assert (report["fps"], report["total_episodes"]) == (10, 10 * len(scenario.retained + scenario.target))


class Rateless(ToyWorld):
    """A world that does not give its steps per second."""

    metadata: dict[str, Any] = {}  # noqa: RUF012


class Faster(ToyWorld):
    """A world with 20 steps per second."""

    metadata: dict[str, Any] = {"render_fps": 20}  # noqa: RUF012


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (Rateless, "worlds:World of the task up does not give its steps per second"),
        (Faster, r"A LeRobotDataset has one rate, but the tasks have \[10.0, 20.0\] steps per second"),
    ],
)
def test_a_world_without_the_rate_of_the_others_is_an_error_that_leaves_nothing(
    world: type, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, up = TOY.retained
    found = {
        left: read_dataset(dataset_folder(left, TOY.budget)),
        dataclasses.replace(up, world="worlds:World"): read_dataset(dataset_folder(up, TOY.budget)),
    }
    module = type(sys)("worlds")
    module.World = world  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "worlds", module)
    with pytest.raises(InputError, match=message):
        write_lerobot(tmp_path, found)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_exported_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="already exists: name a new folder for the export"):
        export_demonstrations(TOY, tmp_path, format="lerobot")
    with pytest.raises(LookupError, match=r"No format is called 'hdf'. Did you mean 'hdf5'\?"):
        export_demonstrations(TOY, tmp_path / "out", format="hdf")  # type: ignore[arg-type]
    with pytest.raises(LookupError, match="Did you mean 'left'"):
        export_demonstrations(TOY, tmp_path / "out", format="lerobot", tasks=["lft"])
    monkeypatch.setattr("clbench.base.dependencies.find_spec", lambda _: None)
    with pytest.raises(MissingPackageError, match=r"pip install 'clbench\[exchange\]'"):
        export_demonstrations(TOY, tmp_path / "out", format="lerobot")
    assert list(tmp_path.iterdir()) == []


def test_episodes_with_action_noise_can_be_left_out(tmp_path: Path, episodes: list[Demonstration]) -> None:
    clean = [episode for episode in episodes if not episode.noisy.any()]
    assert 0 < len(clean) < len(episodes)
    folder = export_demonstrations(TOY, tmp_path / "clean", format="lerobot", noisy=False)
    assert _info(folder)["total_episodes"] == len(clean)
    rows = _rows(next((folder / "data").rglob("*.parquet")))
    expected = np.concatenate([episode.expert[:-1] for episode in clean])
    assert np.array_equal(np.stack(rows["action"]), expected)
    assert not rows["noisy"].any()


def test_an_export_names_the_numbers_of_the_actions_that_never_change(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for kind, tasks, constant in (("lerobot", "left", "0, 1"), ("hdf5", ("left", "right"), "1")):
        export_demonstrations(TOY, tmp_path / kind, format=kind, tasks=tasks)  # type: ignore[arg-type]
        (message,) = caplog.messages
        assert f"the same in every step of this export: {constant}, counted from 0" in message
        assert "docs/guide/external.md#normalise-all-stages-alike" in message
        caplog.clear()
    export_demonstrations(TOY, tmp_path / "all", format="lerobot")
    assert caplog.messages == []


def test_a_task_whose_episodes_all_have_action_noise_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, episodes: list[Demonstration]
) -> None:
    noisy = [episode for episode in episodes if episode.noisy.any()]
    monkeypatch.setattr("clbench.exchange.demonstrations.read_dataset", lambda _: noisy)
    with pytest.raises(InputError, match=rf"All {len(noisy)} demonstrations of left have action noise"):
        export_demonstrations(TOY, tmp_path / "clean", format="lerobot", tasks=["left"], noisy=False)
    assert list(tmp_path.iterdir()) == []


def test_an_export_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr("pyarrow.parquet.write_table", fail)
    with pytest.raises(OSError, match="No space left"):
        export_demonstrations(TOY, tmp_path / "out", format="lerobot")
    assert list(tmp_path.iterdir()) == []
