"""Observers: they show the states of a world to a policy, with pictures where the task has a camera.

Separate processes draw the pictures. Each starts with the back end of MuJoCo that works on this machine,
whatever the main process has imported. If a driver crashes, the run reports it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from clbench.base.cache import cache_folder, cached, hash_of
from clbench.base.entry_points import resolve
from clbench.base.errors import WrongTypeError
from clbench.base.source import package_of, source_hash
from clbench.spec.task import Task
from clbench.worlds.camera import VIEW_SIZE, Camera, Images, Views, load_camera
from clbench.worlds.gl_backend import RenderingError, environment_of, working_back_end
from clbench.worlds.render_worker import END, HEADER
from clbench.worlds.threads import cores
from clbench.worlds.world import States

TOGETHER = 256
"""Pictures per request to a drawing process: 3 MB of 64 x 64 pixels, and half a second of work."""

_PATIENCE = 5.0
"""Longest wait in seconds for a drawing process that was told to end; then it is killed."""


class Observer:
    """Shows the states of a world to a policy, directly or through a camera.

    Args:
        world: Entry point of the world.
        camera: Entry point of the camera, or None.
        processes: Number of drawing processes, which start with the first picture.
    """

    def __init__(self, world: str, camera: str | None, processes: int = 1) -> None:
        self._world, self._entry_point, self._count = world, camera, processes
        self._camera: type[Camera] | None = None if camera is None else load_camera(camera)
        self._processes: list[_DrawingProcess] = []

    @property
    def image_size(self) -> int:
        """Width and height of a picture in pixels; 0 without a camera."""
        return 0 if self._camera is None else self._camera.image_size

    def spaces(self, state: spaces.Box) -> dict[str, spaces.Box]:
        """Return the spaces of an observation by name: `state`, and `image` if there is a camera.

        Args:
            state: Space of the world's own states.
        """
        if self._camera is None:
            return {"state": state}
        size = self._camera.image_size
        return {
            "state": spaces.Box(-np.inf, np.inf, (self._camera.state_size,), np.float32),
            "image": spaces.Box(0, 255, (size, size, 3), np.uint8),
        }

    def observe(self, states: States, views: Views | None = None) -> tuple[States, Images]:
        """Return the observations of the states (N, S): numbers (N, P) and pictures (N, size, size, 3).

        Args:
            states: States of the world, (N, S).
            views: Perturbations of the pictures, (N, 4); None perturbs none.

        Raises:
            RenderingError: No back end can draw the world; the message names the packages to install.
            WrongTypeError: The camera returns numbers of another shape.
        """
        if self._camera is None:
            return states, np.zeros((len(states), 0, 0, 3), np.uint8)
        numbers = self._camera.proprioception(states)
        if numbers.shape != (wanted := (len(states), self._camera.state_size)):
            raise WrongTypeError(
                f"{self._entry_point}: proprioception() must return {wanted}, not {numbers.shape}."
            )
        if views is None:
            views = np.zeros((len(states), VIEW_SIZE), np.float32)
        return numbers, self._draw(np.concatenate([views, states], axis=1, dtype=np.float32))

    def _draw(self, rows: States) -> Images:
        if any(process.is_inherited for process in self._processes):
            self.close()
        if not self._processes:
            assert self._entry_point is not None
            back_end = _back_end(self._world, self._entry_point, os.environ.get("MUJOCO_GL", ""))
            self._processes = [
                _DrawingProcess(self._entry_point, self.image_size, back_end) for _ in range(self._count)
            ]
        pictures = [np.empty((0, self.image_size, self.image_size, 3), np.uint8)]
        share = TOGETHER * len(self._processes)
        for start in range(0, len(rows), share):
            some = rows[start : start + share]
            busy = self._processes[: len(some)]  # no process gets an empty part
            try:
                for process, part in zip(busy, np.array_split(some, len(busy)), strict=True):
                    process.ask(part)
                pictures += [process.answer() for process in busy]
            except BaseException:  # Ctrl-C too: an answer that nobody read would be the next picture
                self.close()
                raise
        return np.concatenate(pictures)

    def close(self) -> None:
        """End the processes that draw."""
        for process in self._processes:
            process.close()
        self._processes = []


class _DrawingProcess:
    """A process that draws: it reads views and states and writes pictures, until it is told to end."""

    def __init__(self, camera: str, image_size: int, back_end: str) -> None:
        self._camera, self._image_size = camera, image_size
        self._asked, self._owner = 0, os.getpid()
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the process
        self._process = subprocess.Popen(
            [sys.executable, "-m", "clbench.worlds.render_worker", camera],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            # Mesa's own threads would fight for the cores with other runs, and take longer for small pictures
            env={**environment_of(back_end), "LP_NUM_THREADS": "0"},
        )

    @property
    def is_inherited(self) -> bool:
        """Whether it draws for the process that this one was forked from."""
        return self._owner != os.getpid()

    def ask(self, rows: States) -> None:
        """Send views and states (N, 4 + S), after waiting until the earlier ones are drawn."""
        assert self._process.stdin is not None
        self._asked = len(rows)
        try:
            self._process.stdin.write(HEADER.pack(*rows.shape) + rows.tobytes())
            self._process.stdin.flush()
        except BrokenPipeError as error:
            raise self._end() from error

    def answer(self) -> Images:
        """Return the pictures of the rows that were sent, (N, size, size, 3)."""
        assert self._process.stdout is not None
        shape = (self._asked, self._image_size, self._image_size, 3)
        answer = self._process.stdout.read(int(np.prod(shape)))
        if len(answer) < np.prod(shape):
            raise self._end()
        return np.frombuffer(answer, np.uint8).reshape(shape)

    def _end(self) -> RenderingError:
        """Return the error for a process that ended too early, with the last line of its error output."""
        code = self._process.wait()
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").strip().splitlines()
        reason = lines[-1] if lines else f"exit code {code}"
        return RenderingError(f"The drawing process of {self._camera} has ended: {reason}")

    def close(self) -> None:
        """End the process, or if it is inherited, only close its files: the owner still needs it."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        # it has died with something unread, or Ctrl-C interrupted an earlier close
        with contextlib.suppress(BrokenPipeError, ValueError):
            if not self.is_inherited:
                self._process.stdin.write(END)
            self._process.stdin.close()
        self._process.stdout.close()
        try:
            self._process.wait(_PATIENCE)  # of an inherited process, it returns at once
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._complaints.close()

    def __del__(self) -> None:
        """End the process of an observer that nobody closed."""
        if hasattr(self, "_process") and not self._complaints.closed:  # else it never began
            self.close()


@functools.cache
def _back_end(world: str, camera: str, chosen: str) -> str:
    """Return the back end that draws a world on this machine; the search takes seconds.

    Where none draws the world itself, which need not have a `render`, the camera alone is tried.
    """
    try:
        return working_back_end([world], chosen)
    except RenderingError:
        return working_back_end([camera], chosen)


def observed(task: Task, states: States) -> tuple[States, Images]:
    """Return the observations of a dataset's states (N, S): numbers (N, P) and pictures.

    All cores draw the pictures on first use; the cache keeps them.

    Raises:
        RenderingError: No back end can draw the world; the message names the packages to install.
    """
    if task.camera is None:
        return Observer(task.world, None).observe(states)
    states = np.ascontiguousarray(states, np.float32)
    inputs = {
        "camera": task.camera,
        "states": [list(states.shape), hashlib.sha256(states.tobytes()).hexdigest()],
        "source": source_hash(package_of(task.camera)),
        "frame": frame_hash(task),
    }
    folder = cache_folder() / "frames" / hash_of(inputs)

    def make(partial: Path) -> None:
        observer = Observer(task.world, task.camera, min(cores(), -(-len(states) // TOGETHER)))
        numbers, images = observer.observe(states)
        observer.close()
        arrays: dict[str, NDArray[Any]] = {"state": np.ascontiguousarray(numbers), "image": images}
        save_file(arrays, partial / "frames.safetensors")

    shown = load_file(cached(folder, inputs, make) / "frames.safetensors")
    return shown["state"], shown["image"]


def frame_hash(task: Task) -> str | None:
    """Return the hash of a picture of a task's world, None without a camera; it changes with the renderer.

    The picture shows the world after `reset(seed=0)`, and is the same for all tasks of the world.

    Raises:
        RenderingError: No back end of this machine can draw the world.
    """
    if task.camera is None:
        return None
    return _frame_hash(task.world, task.camera, os.environ.get("MUJOCO_GL", ""))


@functools.cache
def _frame_hash(world: str, camera: str, chosen: str) -> str:
    environment = resolve(world)()
    state, _ = environment.reset(seed=0)
    environment.close()
    observer = Observer(world, camera)
    _, pictures = observer.observe(np.asarray(state, np.float32)[None])
    observer.close()
    return hashlib.sha256(pictures.tobytes()).hexdigest()[:16]
