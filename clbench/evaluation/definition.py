"""The definition of a scenario: a hash of each task, of the questions and of the camera, by what they do.

A hash covers what a score depends on besides the budget: instructions, horizon and seeds of a task, resets,
rewards and successes of its world, plain and perturbed, the actions of its expert, and the answers to
questions. It is a hash of behaviour in fixed episodes, so an edit that changes no behaviour keeps it. Two
parts are hashes of code, without comments, docstrings and layout: the rule of each task, because fixed
episodes miss a threshold that moves a little, and the module of a camera, because pictures differ between
renderers.

`python -m clbench.evaluation.definition` pins the definitions of the project's scenarios in
`envs/definitions.json`; its arguments are the ids of new ones. Once records of a scenario are public, a
change to it needs a new version instead. Scenarios on LIBERO have no pin: its controller calls BLAS and
LAPACK, whose last bits depend on the processor, and contacts amplify these differences. Their records are
compared with each other.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clbench.base.cache import cache_folder, cached, hash_of
from clbench.base.entry_points import resolve
from clbench.base.source import DATA_SOURCES, package_of, source_hash
from clbench.base.strict_json import read_json
from clbench.data.demonstrations import simulator_versions
from clbench.evaluation.rules import module_code, rule_code
from clbench.records.pinned import pinned, pinned_file
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task, packages_of
from clbench.worlds.camera import load_camera
from clbench.worlds.lanes import is_perturbable, vector_world

CODE = (*DATA_SOURCES, "clbench.evaluation.definition", "clbench.evaluation.rules")
"""Code that a definition depends on, besides the suites of the tasks."""

EPISODES = 4
"""Fixed episodes of each task, and as many perturbed ones."""

GRID = 16
"""Actions of the expert are rounded to multiples of 1/16. The actions of a network differ in their last bits
between processors, and these differences would otherwise grow along an episode."""

RANDOM = 5
"""Every fifth action is random, so that episodes leave the path of the expert."""


def definition(scenario: Scenario) -> dict[str, str]:
    """Return the hashes of a scenario by part.

    Parts are "task NAME" and "rule NAME" for each task, "questions", and "camera" if there is one. A task
    that learns from a file has "demonstrations NAME", too.
    """
    tasks = (*scenario.tasks, *scenario.background, *scenario.scenes)
    suites = packages_of(tasks, "world", "expert", "camera")
    scored = (*scenario.tasks, *scenario.background)
    rules = {f"rule {task.name}": hash_of(rule_code(task)) for task in scored}
    recordings = {f"demonstrations {task.name}": recording_of(task) for task in scored}
    inputs = {
        "tasks": [[*_words(task), task.world, task.expert, task.camera] for task in tasks],
        "scenes": [task.name for task in scenario.scene_tasks],
        "questions": scenario.questions,
        "source": source_hash(*CODE, package_of(scenario.questions), *suites),
        "versions": simulator_versions(tasks),
        "rules": rules,
    }

    def write(folder: Path) -> None:
        (folder / "definition.json").write_text(json.dumps(_hashes(scenario)), encoding="utf-8")

    folder = cached(cache_folder() / "definitions" / hash_of(inputs), inputs, write)
    named = {part: recording for part, recording in recordings.items() if recording is not None}
    return {**read_json(folder / "definition.json"), **rules, **named}


def recording_of(task: Task) -> str | None:
    """Return the hash of the recorded demonstrations that a task names in place of an expert, or None.

    `clbench.exchange.recorded` defines the object that such a task names as its expert.
    """
    recording: str | None = getattr(resolve(task.expert), "recording", None)
    return recording


def _hashes(scenario: Scenario) -> dict[str, str]:
    found: dict[str, str] = {}
    states: dict[str, NDArray[np.float32]] = {}
    scored = (*scenario.tasks, *scenario.background)
    for task in {task.name: task for task in (*scenario.scenes, *scored)}.values():
        found[f"task {task.name}"], states[task.name] = _hash_of_task(task)
    digest = hashlib.sha256()
    shown = np.concatenate([states[task.name] for task in scenario.scene_tasks])
    for kind in resolve(scenario.questions):
        digest.update(json.dumps([kind.name, kind.wordings, kind.answers]).encode())
        digest.update(kind.answer(shown).astype(np.int8).tobytes())
    hashes = {name: found[name] for name in (f"task {task.name}" for task in scored)}
    hashes["questions"] = digest.hexdigest()[:16]
    camera = scored[0].camera  # all tasks share it
    if camera is not None:
        hashes["camera"] = _hash_of_camera(camera, np.concatenate([states[task.name] for task in scored]))
    return hashes


def _hash_of_camera(entry_point: str, states: NDArray[np.float32]) -> str:
    """Return the hash of a camera: its code, and the numbers that it takes from some states."""
    camera = load_camera(entry_point)
    digest = hashlib.sha256(f"{camera.image_size} {module_code(camera.__module__)}".encode())
    for part in (camera.proprioception(states), camera.pictured(states)):
        digest.update(np.asarray(part, np.float32).tobytes())
    return digest.hexdigest()[:16]


def _hash_of_task(task: Task) -> tuple[str, NDArray[np.float32]]:
    """Return the hash of a task, and the states of its fixed episodes."""
    digest = hashlib.sha256(json.dumps(_words(task)).encode())
    states = []
    for perturbed in (False, True) if is_perturbable(task) else (False,):
        for moment in _moments(task, perturbed):
            digest.update(b"".join(np.asarray(part, np.float32).tobytes() for part in moment))
            states.append(moment[0])
    return digest.hexdigest()[:16], np.stack(states)


def _words(task: Task) -> list[object]:
    """Return what defines a task besides its behaviour."""
    wordings = [list(task.instructions), list(task.test_instructions)]
    return [task.name, task.seed_suite, task.version, task.horizon, task.action_noise, wordings]


def _moments(task: Task, perturbed: bool) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the steps of the fixed episodes: state, action, reward and success, and the last state alone.

    All actions are random if the task has no expert.
    """
    expert = resolve(task.expert)(task.name) if recording_of(task) is None else None
    with contextlib.closing(vector_world(task.world, 1, 1, perturbed)) as world:
        space = world.single_action_space
        generator = np.random.default_rng(0)
        for seed in range(EPISODES):
            state = world.reset([0], [seed], [task.name])[0].copy()
            for step in range(task.horizon):
                if expert is None or step % RANDOM == RANDOM - 1:
                    action = generator.uniform(space.low, space.high)
                else:
                    action = np.round(np.asarray(expert(state)) * GRID) / GRID
                after, rewards, successes = world.step([0], action[None].astype(np.float32))
                yield state, action, rewards, successes
                state = after[0].copy()
                if successes[0]:
                    break
            yield (state,)


def main() -> None:
    """Pin the definitions of the scenarios that have a pin or are named as arguments."""
    found = {name: definition(load_scenario(name)) for name in sorted({*pinned(), *sys.argv[1:]})}
    pinned_file().write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
