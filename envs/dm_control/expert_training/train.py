"""Training of experts with the SAC of stable-baselines3; a kill loses at most a minute of work."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from clbench.base.cache import cache_folder, hash_of
from clbench.base.dependencies import versions
from clbench.base.errors import InputError
from clbench.base.leftovers import unfinished
from clbench.base.seeding import SPLIT_LABELS, derive_seed, seeded
from clbench.base.source import source_hash

from ..episode import Episode
from ..experts import Expert, ExpertError
from ..rules import HORIZON, SUCCESS_SHARE
from .sac import WrittenOutSAC
from .symmetry import SYMMETRIES

TEST_EPISODES = 100
"""Number of episodes that measure the mean return and the success of an expert."""
VALIDATION_EPISODES = 10
"""Number of other episodes after each segment, which choose the best actor; the latest of equals wins."""
ROUND = 8
"""Decisions between updates; each update takes half as many gradient steps."""
REPLAY_SIZE = 100_000
"""Decisions that the replay buffer keeps, and the longest training."""
PACKAGES = ("dm-control", "mujoco", "numpy", "stable-baselines3", "torch")
SOURCES = ("episode", "expert_training", "experts", "rules", "scene", "state")
"""Modules and packages of the suite that a training depends on."""

STEPS = {
    "point_mass_easy": 10_000,
    "point_mass_right": 10_000,
    "cartpole_left": 12_000,
    "cartpole_swingup": 20_000,
    "ball_in_cup_catch": 36_000,
    "ball_in_cup_right": 6_000,
}
"""Decisions after which each expert does its task, found by training."""


@dataclass(frozen=True)
class Settings:
    """The inputs that determine the weights of an expert."""

    task: str
    seed: int = 0
    steps: int = 20_000
    """Decisions, with one gradient step for every two after the first segment, whose actions are random."""
    segment: int = 1_000
    """Decisions between two checkpoints. The number of a segment seeds all its draws, so that a killed
    training ends with the same bits as an uninterrupted one."""
    width: int = 64
    """Units of each of the two hidden layers, of actor and critics."""
    batch_size: int = 128
    learning_rate: float = 1e-3
    discount: float = 0.98
    """Discount per step: a horizon of about 50 steps, 2 s and for the point mass 8 s."""
    target_rate: float = 0.01
    """Share of the critics' weights that the target critics adopt at each step."""

    def __post_init__(self) -> None:
        whole = self.steps % self.segment == self.segment % HORIZON == self.segment % ROUND == 0
        if not whole or not 0 < self.steps <= REPLAY_SIZE:
            raise InputError(
                f"An expert is trained for a multiple of {self.segment:,} steps, at most {REPLAY_SIZE:,}, "
                f"not {self.steps:,}; episodes have {HORIZON}."
            )


class TrainingWorld(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A task of the dm_control world for SAC, with the body's own scaled observation and action.

    Args:
        task: Name of the task.
        seeds: Maps the number of an episode to its seed.
    """

    def __init__(self, task: str, seeds: Callable[[int], int]) -> None:
        self._episode, self._task, self._seeds = Episode(), task, seeds
        self.number, self._steps = 0, 0
        size = len(self._episode.reset(task, 0))
        self.scale = np.array(self._episode.start.body.scale, np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, self._episode.data.ctrl.shape, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next episode, seeded by its number."""
        observation = self._episode.reset(self._task, self._seeds(self.number))
        self.number, self._steps = self.number + 1, 0
        return observation.astype(np.float32) / self.scale, {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Move for one step; the horizon truncates the episode."""
        observation = self._episode.step(action)
        self._steps += 1
        reward = self._episode.training_reward(observation)
        return observation.astype(np.float32) / self.scale, reward, False, self._steps == HORIZON, {}


def returns(expert: Expert, task: str, purpose: str, episodes: int) -> NDArray[np.float64]:
    """Return the returns (N,) of an expert's episodes; `purpose` and number seed the initial states."""
    episode, sums = Episode(), np.zeros(episodes)
    for number in range(episodes):
        observation = episode.reset(task, derive_seed("expert", task, SPLIT_LABELS[purpose], number))
        for _ in range(HORIZON):
            observation = episode.step(expert.act(observation))
            sums[number] += episode.reward(observation)
    return sums


def steps_of(task: str) -> int:
    """Return the number of training steps of the included expert of a task."""
    symmetry = SYMMETRIES.get(task)
    return STEPS[symmetry.of if symmetry else task]


def checkpoint_path(settings: Settings) -> Path:
    """Return the path of a training's checkpoint, from which a longer training continues."""
    inputs = {
        **{name: value for name, value in asdict(settings).items() if name != "steps"},
        "source": source_hash(
            *(f"clbench.envs.dm_control.{part}" for part in SOURCES), "clbench.base.seeding"
        ),
        "versions": versions(PACKAGES),
    }
    name = f"{settings.task}-seed-{settings.seed}-{hash_of(inputs)}.safetensors"
    return cache_folder() / "experts" / name


@dataclass
class _Best:
    """The best actor so far, and the results of all actors."""

    actor: dict[str, Tensor]
    value: float
    curve: list[list[float]]
    """Pairs of a number of steps and the mean return of the actor in the validation episodes."""


def train(
    settings: Settings, folder: Path, progress: Callable[[float, str], None] = lambda _, __: None
) -> dict[str, Any]:
    """Train an expert, write its weights and its JSON to `folder`, and return the content of the JSON.

    An interrupted training continues from its checkpoint in the cache. If a symmetry derives the expert from
    another task's expert, the other expert is trained, and the derived one is measured on its own task.

    Args:
        settings: Inputs that determine the weights.
        folder: Folder for both files.
        progress: Called after each segment with the number of new steps and a line of text.

    Raises:
        UnknownNameError: No task has this name; the error names the nearest one.
        ExpertError: The checkpoint is unreadable; the message names it.
    """
    torch.set_num_threads(1)
    symmetry = SYMMETRIES.get(settings.task)
    trained = settings if symmetry is None else dataclasses.replace(settings, task=symmetry.of)
    best = _train(trained, progress)
    expert = _expert(best.actor) if symmetry is None else symmetry.apply(_expert(best.actor))
    return _ship(settings, expert, best.curve, folder)


def _train(settings: Settings, progress: Callable[[float, str], None]) -> _Best:
    """Start or continue a training, and return its best actor."""
    world = TrainingWorld(
        settings.task, lambda number: derive_seed("expert", settings.task, "training", settings.seed, number)
    )
    path = checkpoint_path(settings)
    with seeded("expert", settings.task, settings.seed, "weights"):
        trainer = _sac(settings, world)
    best = _Best(_actor(trainer, world), -math.inf, [])
    if path.exists():
        best = _read_checkpoint(trainer, path)
        progress(trainer.num_timesteps, f"continues after {trainer.num_timesteps:,} steps, from {path}")
        if trainer.num_timesteps > settings.steps:
            raise ExpertError(
                f"{path} has {trainer.num_timesteps:,} steps, more than {settings.steps:,}. Ask for at least "
                "as many, or delete it to start again."
            )
    while trainer.num_timesteps < settings.steps:
        begin = time.monotonic()
        world.number = trainer.num_timesteps // HORIZON
        trainer._last_obs = None  # `learn` then resets the world: segments are whole episodes
        with seeded("expert", settings.task, settings.seed, trainer.num_timesteps):
            trainer.action_space.seed(derive_seed("explore", settings.seed, trainer.num_timesteps))
            trainer.learn(settings.segment, reset_num_timesteps=False)
        value = float(
            returns(_expert(_actor(trainer, world)), settings.task, "validation", VALIDATION_EPISODES).mean()
        )
        best.curve.append([trainer.num_timesteps, round(value, 3)])
        if value >= best.value:
            best = _Best(_actor(trainer, world), value, best.curve)
        _write_checkpoint(trainer, best, path)
        pace = settings.segment / (time.monotonic() - begin)
        progress(
            settings.segment,
            f"{trainer.num_timesteps:,} of {settings.steps:,} steps, return {value:.1f} of {HORIZON}, "
            f"best {best.value:.1f}, {pace:.0f} steps/s",
        )
    return best


def _sac(settings: Settings, world: TrainingWorld) -> WrittenOutSAC:
    return WrittenOutSAC(
        "MlpPolicy",
        world,
        learning_rate=settings.learning_rate,
        buffer_size=REPLAY_SIZE,
        learning_starts=settings.segment,
        batch_size=settings.batch_size,
        train_freq=ROUND,
        gradient_steps=ROUND // 2,
        tau=settings.target_rate,
        gamma=settings.discount,
        ent_coef="auto_0.1",
        policy_kwargs={"net_arch": [settings.width] * 2},
        device="cpu",
    )


def _actor(trainer: WrittenOutSAC, world: TrainingWorld) -> dict[str, Tensor]:
    """Return a copy of the layers that map dm_control's observation to the mean action."""
    state = trainer.policy.actor.state_dict()
    names = ("latent_pi.0", "latent_pi.2", "mu")
    actor = {
        f"{number}.{kind}": state[f"{name}.{kind}"].clone()
        for number, name in enumerate(names)
        for kind in ("weight", "bias")
    }
    return actor | {"0.weight": actor["0.weight"] / torch.from_numpy(world.scale)}


def _expert(actor: dict[str, Tensor]) -> Expert:
    layers = len(actor) // 2
    return Expert(
        tuple(
            (actor[f"{number}.weight"].numpy(), actor[f"{number}.bias"].numpy()) for number in range(layers)
        )
    )


def _tensors(trainer: WrittenOutSAC) -> Iterator[tuple[str, Tensor]]:
    """Yield the whole state of a training by name, in the training's own memory."""
    yield from ((f"policy.{name}", value) for name, value in trainer.policy.state_dict().items())
    assert trainer.log_ent_coef is not None
    assert trainer.replay_buffer is not None
    yield "log_ent_coef", trainer.log_ent_coef.data
    yield from ((f"moments.{name}", torch.from_numpy(values)) for name, values in trainer.moments())
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        yield (
            f"replay.{name}",
            torch.from_numpy(getattr(trainer.replay_buffer, name)[: trainer.num_timesteps]),
        )


def _write_checkpoint(trainer: WrittenOutSAC, best: _Best, path: Path) -> None:
    """Replace the checkpoint atomically, so that a kill leaves the old or the new one."""
    tensors = {name: value.clone() for name, value in _tensors(trainer)}  # safetensors refuses shared memory
    tensors |= {f"best.{name}": value for name, value in best.actor.items()}
    words = {"steps": trainer.num_timesteps, "updates": trainer._n_updates, "value": best.value}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = unfinished(path)
    save_file(tensors, partial, metadata={"training": json.dumps(words | {"curve": best.curve})})
    partial.replace(path)


def _read_checkpoint(trainer: WrittenOutSAC, path: Path) -> _Best:
    """Restore the state of a training, and return its best actor so far.

    Raises:
        ExpertError: The file is damaged, or not a checkpoint of such a training.
    """
    try:
        with safe_open(path, "pt") as file:
            words = json.loads(file.metadata()["training"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        trainer.num_timesteps = int(words["steps"])
        trainer.resumed(int(words["updates"]))
        for name, value in _tensors(trainer):
            value.copy_(tensors[name])
        actor = {
            f"{number}.{kind}": tensors[f"best.{number}.{kind}"]
            for number in range(3)
            for kind in ("weight", "bias")
        }
        best = _Best(actor, float(words["value"]), list(words["curve"]))
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, SafetensorError) as error:
        raise ExpertError(
            f"{path} is not a checkpoint of this training ({error}). Delete it to start again."
        ) from error
    assert trainer.replay_buffer is not None
    trainer.replay_buffer.pos = trainer.num_timesteps
    return best


def _ship(settings: Settings, expert: Expert, curve: list[list[float]], folder: Path) -> dict[str, Any]:
    """Measure an expert, write its files, and return the content of the JSON."""
    task = settings.task
    sums = returns(expert, task, "test", TEST_EPISODES)
    content = expert.to_bytes()
    symmetry = SYMMETRIES.get(task)
    card = {
        "task": task,
        "command": f"clbench experts train {task} --seed {settings.seed} --steps {settings.steps}",
        "symmetric_to": symmetry.of if symmetry else None,
        "return": round(float(sums.mean()), 3),
        "lowest_return": round(float(sums.min()), 3),
        "success": float((sums >= SUCCESS_SHARE * sums.mean()).mean()),
        "episodes": TEST_EPISODES,
        "settings": asdict(settings),
        "curve": curve,
        "sizes": [expert.layers[0][0].shape[1], *(len(bias) for _, bias in expert.layers)],
        "sha256": hashlib.sha256(content).hexdigest(),
        "versions": versions(PACKAGES),
    }
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(card, indent=1) + "\n"
    made = {folder / f"{task}.safetensors": content, folder / f"{task}.json": text.encode()}
    partial = {path: unfinished(path) for path in made}
    for path, data in made.items():
        partial[path].write_bytes(data)
    for path in made:  # both are whole: a card beside other weights would be refused
        partial[path].replace(path)
    return card
