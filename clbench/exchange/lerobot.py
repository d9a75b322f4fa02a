"""Demonstrations as a LeRobotDataset v3: Parquet files and their statistics, written without LeRobot.

`action` is the expert's action in each state, which the policies of clbench learn. Where action noise
replaced it, `noisy` is true and `executed` holds the action that led to the next state.

Source: `lerobot.datasets` 0.6.1, https://huggingface.co/docs/lerobot/lerobot-dataset-v3.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as parquet
from numpy.typing import NDArray

from clbench.base.errors import InputError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.data.demonstrations import Demonstration
from clbench.evaluation.views import SimulatorCameras
from clbench.exchange.shown import Shown, shown, steps_per_second
from clbench.spec.task import Task

FILE = "chunk-000/file-000.parquet"
"""Only file of the data, and of the facts about episodes, whatever its size."""

IMAGE = "observation.images.image"
"""Name of the picture that a policy sees; the camera is called image, as in `clbench/serving/server.py`."""

ENVIRONMENT_STATE = "observation.environment_state"
"""Second name of the state where there is no picture: LeRobot's ACT and diffusion policies need one of the
two."""

QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
"""Quantiles among the statistics, as in LeRobot: q01 to q99."""

Columns = dict[str, NDArray[Any]]
"""Values of an episode by feature, (T,), (T, N), or pictures (T, N, N, 3)."""


def write_lerobot(
    folder: Path,
    tasks: Mapping[Task, Sequence[Demonstration]],
    cameras: SimulatorCameras | None = None,
    progress: ProgressCallback = no_progress,
) -> None:
    """Write the demonstrations of tasks as one LeRobotDataset, episode after episode.

    The `task` of each episode is a wording of its instruction; the wordings of a task take turns.

    Args:
        folder: Folder to fill.
        tasks: Demonstrations by task.
        cameras: Cameras of the simulator whose pictures to add; None adds none.
        progress: Called with the number of episodes written since its last call.

    Raises:
        InputError: A world does not give its steps per second, two worlds have different rates, or an episode
            cannot be played again.
        RenderingError: The tasks have a camera or `cameras` are given, and this machine cannot draw.
    """
    rates = {steps_per_second(task) for task in tasks}
    if len(rates) > 1:
        raise InputError(
            f"A LeRobotDataset has one rate, but the tasks have {sorted(rates)} steps per second."
        )
    (rate,) = rates
    texts = list(dict.fromkeys(words for task in tasks for words in task.instructions))
    meta = folder / "meta"
    features, condensed = _write_frames(
        folder / "data" / FILE, _episodes(tasks, texts, rate, cameras), progress
    )
    _write_table(meta / "episodes" / FILE, _facts(condensed, features, texts))
    indices = pd.DataFrame({"task_index": range(len(texts))}, index=pd.Index(texts, name="task"))
    _write_table(meta / "tasks.parquet", pa.Table.from_pandas(indices))
    every = {
        name: _joined([episode[name] for episode in condensed], feature) for name, feature in features.items()
    }
    info = {
        "codebase_version": "v3.0",
        "robot_type": next(iter(tasks)).suite,
        "total_episodes": len(condensed),
        "total_frames": len(every["index"]),
        "total_tasks": len(texts),
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": int(rate) if rate.is_integer() else rate,
        "splits": {"train": f"0:{len(condensed)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }
    for name, content in (("info.json", info), ("stats.json", _statistics(every, features))):
        (meta / name).write_text(json.dumps(content, indent=4), encoding="utf-8")


def _episodes(
    tasks: Mapping[Task, Sequence[Demonstration]],
    texts: Sequence[str],
    rate: float,
    cameras: SimulatorCameras | None,
) -> Iterator[Columns]:
    """Yield the columns of each episode."""
    frames = number = 0
    for task, episodes in tasks.items():
        for place, one in enumerate(shown(task, episodes, cameras)):
            words = task.instructions[place % len(task.instructions)]
            yield _columns(one, number, frames, texts.index(words), rate)
            number, frames = number + 1, frames + len(one.state)


def _columns(one: Shown, number: int, first: int, text: int, rate: float) -> Columns:
    """Return the columns of an episode.

    Args:
        one: The episode.
        number: Number of the episode.
        first: Number of its first frame among all frames.
        text: Number of its instruction.
        rate: Steps per second.
    """
    episode, steps = one.episode, np.arange(len(one.state))
    done = steps == len(steps) - 1
    seen = {f"observation.images.{name}": pictures for name, pictures in one.pictures.items()}
    if one.image.size:
        seen = {IMAGE: one.image, **seen}
    return {
        "observation.state": one.state,
        **(seen or {ENVIRONMENT_STATE: one.state}),
        "action": episode.expert[:-1],
        "executed": episode.executed,
        "noisy": episode.noisy[:-1],
        "next.reward": episode.reward,
        "next.done": done,
        "next.success": done & episode.success,
        "timestamp": (steps / rate).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(len(steps), number),
        "index": steps + first,
        "task_index": np.full(len(steps), text),
    }


def _write_frames(
    path: Path, episodes: Iterator[Columns], progress: ProgressCallback
) -> tuple[dict[str, dict[str, Any]], list[Columns]]:
    """Write the frames of all episodes to a Parquet file, with one row group for each episode.

    Returns:
        The features of info.json, and the columns of each episode, condensed: the pictures of one LIBERO task
        would take gigabytes of memory.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    first = next(episodes)
    features = {name: _feature(values) for name, values in first.items()}
    condensed = []
    with parquet.ParquetWriter(path, _table(first, features).schema) as writer:
        for episode in chain([first], episodes):
            writer.write_table(_table(episode, features))
            condensed.append({name: _condensed(values) for name, values in episode.items()})
            progress(1)
    return features, condensed


def _feature(values: NDArray[Any]) -> dict[str, Any]:
    """Return the entry of a column in info.json."""
    if values.ndim == 4:
        names = ["height", "width", "channels"]
        return {"dtype": "image", "shape": list(values.shape[1:]), "names": names}
    return {"dtype": str(values.dtype), "shape": list(values.shape[1:]) or [1], "names": None}


def _table(episode: Columns, features: Mapping[str, Mapping[str, Any]]) -> pa.Table:
    """Return the frames of an episode as a table of Arrow."""
    return pa.table({name: _array(episode[name], features[name]["dtype"]) for name in features})


def _array(values: NDArray[Any], kind: str) -> pa.Array:
    if kind == "image":
        pictures = [{"bytes": _png(picture), "path": None} for picture in values]
        return pa.array(pictures, pa.struct({"bytes": pa.binary(), "path": pa.string()}))
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    # LeRobot reads a feature of one number as a number, not as a list
    width = values.shape[1] if values.ndim == 2 else 1
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


def _png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture (N, N, 3) as a PNG file, which loses nothing."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


def _facts(
    episodes: Sequence[Columns], features: Mapping[str, Mapping[str, Any]], texts: Sequence[str]
) -> pa.Table:
    """Return the facts about each episode: its place in the data, its task, and its statistics."""
    rows = []
    for episode in episodes:
        first, length = int(episode["index"][0]), len(episode["index"])
        stats = _statistics(episode, features)
        rows.append(
            {
                "episode_index": int(episode["episode_index"][0]),
                "tasks": [texts[int(episode["task_index"][0])]],
                "length": length,
                "data/chunk_index": 0,
                "data/file_index": 0,
                "dataset_from_index": first,
                "dataset_to_index": first + length,
                **{f"stats/{name}/{key}": value for name, one in stats.items() for key, value in one.items()},
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
    return pa.Table.from_pylist(rows)


def _condensed(values: NDArray[Any]) -> NDArray[Any]:
    """Return a column as it is, or the counts of levels (256, 3) in pictures (T, N, N, 3)."""
    if values.ndim < 4:
        return values
    counts = np.zeros((256, 3))
    for picture in values:
        for colour in range(3):
            counts[:, colour] += np.bincount(picture[..., colour].ravel(), minlength=256)
    return counts


def _joined(parts: Sequence[NDArray[Any]], feature: Mapping[str, Any]) -> NDArray[Any]:
    """Return the condensed column of all episodes."""
    return np.sum(parts, axis=0) if feature["dtype"] == "image" else np.concatenate(parts)


def _statistics(
    columns: Columns, features: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, list[Any]]]:
    """Return the statistics of condensed columns: per number, or per colour (3, 1, 1) from 0 to 1."""
    statistics: dict[str, dict[str, list[Any]]] = {}
    for name, values in columns.items():
        if features[name]["dtype"] == "image":
            found = {key: value.reshape(3, 1, 1) for key, value in _of_pictures(values).items()}
        else:
            found = _of_numbers(values.reshape(len(values), -1).astype(np.float64))
        statistics[name] = {key: value.tolist() for key, value in found.items()}
        statistics[name]["count"] = [len(columns["index"])]
    return statistics


def _of_numbers(rows: NDArray[np.float64]) -> Columns:
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        **_named(np.quantile(rows, QUANTILES, axis=0)),
    }


def _of_pictures(counts: NDArray[np.float64]) -> Columns:
    """Return the statistics of pictures per colour (3,), from how often each of the 256 levels occurs."""
    levels, total = np.arange(256)[:, None] / 255, counts[:, 0].sum()
    mean = (counts * levels).sum(axis=0) / total
    until = counts.cumsum(axis=0)

    def ranked(rank: float) -> NDArray[np.float64]:
        """Return the value at a rank, counted from 0 in ascending order, for each colour."""
        return np.asarray((until > rank).argmax(axis=0) / 255)

    def quantile(share: float) -> NDArray[np.float64]:
        place = share * (total - 1)
        low, high = ranked(np.floor(place)), ranked(np.ceil(place))
        return np.asarray(low + (high - low) * (place % 1))

    return {
        "min": ranked(0),
        "max": ranked(total - 1),
        "mean": mean,
        "std": np.sqrt((counts * (levels - mean) ** 2).sum(axis=0) / total),
        **_named([quantile(share) for share in QUANTILES]),
    }


def _named(quantiles: Iterable[NDArray[np.float64]]) -> Columns:
    """Return quantiles by the names that LeRobot gives them."""
    return {f"q{100 * share:02.0f}": one for share, one in zip(QUANTILES, quantiles, strict=True)}


def _write_table(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, path)
