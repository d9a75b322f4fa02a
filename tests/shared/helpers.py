"""Functions that several test files call; `pythonpath` in pyproject.toml lets them import this module."""

import base64
import dataclasses
import functools
import gzip
import io
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from numpy.typing import NDArray
from torch import Tensor

from clbench.base.entry_points import resolve
from clbench.base.errors import MissingPackageError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.data.demonstrations import Demonstration
from clbench.jobs.bars import Bars
from clbench.learning.method import Method
from clbench.learning.registry import load_method, new_method, read_changes
from clbench.policy.policy import Policy
from clbench.records.content import content_hash
from clbench.records.paths import record_path
from clbench.records.record import AnswerRow, EpisodeRow, PolicyRow, Record
from clbench.records.writer import record_text, write_record
from clbench.runs.spec import ResolvedRun
from clbench.runs.stages import kept_stages, load_stages, make_stages
from clbench.scoring.reading import read_protocol
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.gl_backend import DEBIAN_PACKAGES, rendering_fault


def reverse_targets(record: Record) -> None:
    """Let a record have learned its targets in the opposite order, with the same success in each stage."""
    target = record.scenario.target
    swapped = dict(zip(target, reversed(target), strict=True))
    target.reverse()
    record.episodes["task"] = [swapped.get(task, task) for task in record.episodes["task"]]


def output_of(code: str) -> str:
    """Return what a Python program prints in a process of its own, which must succeed."""
    command = [sys.executable, "-c", code]  # what it says of an error goes to the report of the test
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


def is_gone(process: int) -> bool:
    """Return whether a process ends within a minute; a zombie has ended."""
    for _ in range(600):
        try:
            if psutil.Process(process).status() == psutil.STATUS_ZOMBIE:
                return True
        except psutil.NoSuchProcess:
            return True
        time.sleep(0.1)
    return False


def scenario_or_skip(scenario_id: str) -> Scenario:
    """Return a scenario, or skip the test where a package that it needs is not installed."""
    try:
        return load_scenario(scenario_id)
    except MissingPackageError as error:
        pytest.skip(str(error))


def back_end_or_skip() -> str:
    """Return a back end of MuJoCo that works on this machine, or skip the test.

    Only a rendering context is tried: a world that cannot be drawn is a bug, and its test must fail.
    """
    back_end = _working_back_end()
    if back_end is None:
        pytest.skip("nothing renders here: clbench doctor shows the missing parts")
    return back_end


@functools.cache
def _working_back_end() -> str | None:
    chosen = os.environ.get("MUJOCO_GL")
    back_ends = (chosen,) if chosen else tuple(DEBIAN_PACKAGES)
    return next((one for one in back_ends if rendering_fault(one) is None), None)


def build_method(spec: str, changes: Mapping[str, Any]) -> Method:
    """Return the method called `spec`, with changed hyper-parameters as a run reads them."""
    cls = load_method(spec)
    return new_method(spec, cls, read_changes(spec, cls, changes))


def sealed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record's JSON with the hash of its content as `content`."""
    return {**values, "content": content_hash(values)}


def resealed(content: bytes) -> bytes:
    """Return the file of a record with the hash of its content if it is one: a forger would not forget it."""
    try:
        values = json.loads(content)
        return json.dumps(sealed(values)).encode() if isinstance(values, dict) else content
    except (ValueError, TypeError, RecursionError):
        return content


def write_unchecked(record: Record, path: Path) -> None:
    """Write a record of any content; `write_record` would read it again, and refuse a faulty one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(record_text(record), encoding="utf-8")


def complete_record(record: Record) -> None:
    """Add what a record lacks of its budget."""
    protocol = read_protocol(record)
    columns = (record.episodes[name] for name in ("stage", "step", "task", "split", "episode"))
    played = set(zip(*columns, strict=True))
    moved = set(zip(record.policy["stage"], record.policy["step"], strict=True))
    answers = [AnswerRow(*row) for row in zip(*record.answers.values(), strict=True)]
    asked = sum(row.asked for row in answers if row.stage == 0)
    record.scenario.budget.setdefault("test_questions", asked)
    for point in (point for stage in protocol.stages for point in protocol.points(stage)):
        for key in protocol.episodes(point):
            if (*point, *key) not in played:
                record.add_episode(EpisodeRow(*point, key.task, key.split, key.number, 0, 0.0, 50))
        if point not in moved and not record.run.trained_elsewhere:
            record.add_policy(PolicyRow(*point, None, None, None, None))
        for row in answers:
            if row.stage == point.stage - 1 and not protocol.is_end(point):
                record.add_answers(row._replace(stage=point.stage, step=point.step))


def expert_succeeds(task: Task, seed: int, noise: Sequence[Any] | NDArray[Any] = ()) -> bool:
    """Run the task's expert for an episode, with `noise` for actions from the tenth step on."""
    world, expert = resolve(task.world)(), resolve(task.expert)(task.name)
    state, _ = world.reset(seed=seed, options={"task": task.name})
    for step in range(task.horizon):
        action = noise[step - 10] if 10 <= step < 10 + len(noise) else expert(state)
        state, _, terminated, truncated, info = world.step(action)
        assert not truncated
        assert info == {"success": terminated, "task": task.name}
        if terminated:
            return True
    return False


def same_demonstrations(first: list[Demonstration], second: list[Demonstration]) -> bool:
    """Return whether two lists hold the same episodes, bit for bit."""
    return all(
        np.array_equal(a, b)
        for one, other in zip(first, second, strict=True)
        for a, b in zip(dataclasses.astuple(one), dataclasses.astuple(other), strict=True)
    )


def data_of(page: str) -> Any:
    """Return the data that a page of the leaderboard unpacks when it opens."""
    (packed,) = re.findall(r'<script type="application/gzip" id="data">(.*?)</script>', page)
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def unpacked(page: str) -> str:
    """Return a page with its data as text: compressed bytes depend on the version of zlib."""
    return re.sub(
        r'(id="data">).*?(</script>)', lambda found: json.dumps(data_of(page)).join(found.groups()), page
    )


def blocks_of(page: Path, language: str) -> list[str]:
    """Return the blocks of code in a language that a page of the documentation shows, in their order."""
    found: list[str] = re.findall(
        rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL
    )
    return found


def set_in(name: str, key: str, value: Any) -> Callable[[Record], None]:
    """Return a function that sets an entry, or a field, of one part of a record."""

    def edit(record: Record) -> None:
        part = getattr(record, name)
        if isinstance(part, dict):
            part[key] = value
        else:
            setattr(part, key, value)

    return edit


def weights_of(policy: Policy) -> dict[str, Tensor]:
    """Return a copy of the parameters of a policy, by name."""
    return {name: weight.detach().clone() for name, weight in policy.named_parameters()}


RATES = [[1.0, 0.5, 0.0, 0.0, 0.25], [0.5, 0.25, 1.0, 0.0, 0.0], [0.0, 0.5, 0.75, 1.0, 0.0]]
"""Success rates of a run of two targets: after each stage, on two skills, the targets and a held-out task."""


def write_two_records(folder: Path, make_record: Callable[..., Record]) -> Path:
    """Write two records to a folder, one of them with changed settings, and a file that is none."""
    for method, seed, changes in (("sft", 0, {}), ("lora", 3, {"rank": 4})):
        record = make_record(RATES, episodes=4, method=method, seed=seed, changes=changes, settings=changes)
        name = "lora+rank=4" if changes else method
        write_record(record, record_path(folder, "clbench/Toy-v0", name, seed))
    (folder / "notes.json").write_text("{}")
    return folder


def printed(bars: Bars) -> str:
    """Return what bars that draw into a text have printed."""
    assert isinstance(bars.console.file, io.StringIO)
    return bars.console.file.getvalue()


def stage_policies(
    run: ResolvedRun, checkpoints: Path | None = None, progress: ProgressCallback = no_progress
) -> list[Policy]:
    """Return the policy after every stage of a run: those that it kept below a folder, or made again."""
    return load_stages(run, kept_stages(run, checkpoints) or make_stages(run, progress))


def lose_home(patch: pytest.MonkeyPatch) -> None:
    """Act as a user without an account who has named no folder for data."""

    def has_no_account(_: int) -> None:
        raise KeyError

    for name in ("HOME", "CLBENCH_CACHE", "XDG_CACHE_HOME", "MINARI_DATASETS_PATH"):
        patch.delenv(name, raising=False)
    patch.setattr("pwd.getpwuid", has_no_account)
