"""Training of experts by the SAC of stable-baselines3, which a kill cannot set back by more than a minute."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
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
from clbench.base.seeding import SPLIT_LABELS, derive_seed, seeded
from clbench.base.source import source_hash

from .episode import Episode
from .expert import Expert, ExpertError
from .rules import HORIZON, SUCCESS_SHARE
from .sac import WrittenOutSAC
from .symmetry import SYMMETRIES

TEST_EPISODES = 100
"""Episodes that the mean return and the success of an expert are measured on."""
VALIDATION_EPISODES = 10
"""Other episodes, after each segment: the actor that does best on them is kept, of equals the latest."""
ROUND = 8
"""Decisions between gradient steps, which are taken by half as many at once."""
REPLAY_SIZE = 100_000
"""Decisions that are kept, and the most of a training."""
PACKAGES = ("dm-control", "mujoco", "numpy", "stable-baselines3", "torch")
SOURCES = ("bodies", "episode", "expert", "rules", "sac", "state", "symmetry")
"""Modules beside this one that a training depends on."""


STEPS = {
    "point_mass_easy": 10_000,
    "point_mass_right": 10_000,
    "cartpole_left": 12_000,
    "cartpole_swingup": 20_000,
    "ball_in_cup_catch": 36_000,
    "ball_in_cup_right": 6_000,
}
"""Decisions after which each does what it is to, found by training."""


@dataclass(frozen=True)
class Settings:
    """What the weights of an expert follow from."""

    task: str
    seed: int = 0
    steps: int = 20_000
    """Decisions, with one gradient step for every two after the first segment, which is at random."""
    segment: int = 1_000
    """Decisions between two checkpoints. All draws of a segment follow from its number, so that a training
    that was killed ends in the same bits as one that was not."""
    width: int = 64
    """Units of each of the two hidden layers, of actor and critics."""
    batch_size: int = 128
    learning_rate: float = 1e-3
    discount: float = 0.98
    """Per step of 0.04 s: the future counts for some 2 s."""
    target_rate: float = 0.01
    """Share of the critics that their slow copies take over at each step."""

    def __post_init__(self) -> None:
        whole = self.steps % self.segment == self.segment % HORIZON == self.segment % ROUND == 0
        if not whole or not 0 < self.steps <= REPLAY_SIZE:
            raise InputError(
                f"An expert is trained for a multiple of {self.segment:,} steps, at most {REPLAY_SIZE:,}, "
                f"not {self.steps:,}; episodes have {HORIZON}."
            )


class TrainingWorld(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A task of the dm_control world as SAC meets it: its body's own observation, to scale, and action.

    Args:
        task: Name of the task.
        seeds: Seed of each episode.
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
        """Begin the next episode; its seed follows from its number."""
        observation = self._episode.reset(self._task, self._seeds(self.number))
        self.number, self._steps = self.number + 1, 0
        return observation.astype(np.float32) / self.scale, {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Move for one step; the episode is cut at the horizon."""
        observation = self._episode.step(action)
        self._steps += 1
        reward = self._episode.training_reward(observation)
        return observation.astype(np.float32) / self.scale, reward, False, self._steps == HORIZON, {}


def returns(expert: Expert, task: str, purpose: str, episodes: int) -> NDArray[np.float64]:
    """Return what an expert's episodes (N,) return; the initial states follow from `purpose` and number."""
    episode, sums = Episode(), np.zeros(episodes)
    for number in range(episodes):
        observation = episode.reset(task, derive_seed("expert", task, SPLIT_LABELS[purpose], number))
        for _ in range(HORIZON):
            observation = episode.step(expert.act(observation))
            sums[number] += episode.reward(observation)
    return sums


def steps_of(task: str) -> int:
    """Return for how many steps the expert of a task is trained that comes with clbench."""
    symmetry = SYMMETRIES.get(task)
    return STEPS[symmetry.of if symmetry else task]


def checkpoint_path(settings: Settings) -> Path:
    """Return where the checkpoint of a training lies, or will lie; a longer training goes on from it."""
    inputs = {
        **{name: value for name, value in asdict(settings).items() if name != "steps"},
        "source": source_hash(
            __name__, *(f"{__package__}.{part}" for part in SOURCES), "clbench.base.seeding"
        ),
        "versions": versions(PACKAGES),
    }
    name = f"{settings.task}-seed-{settings.seed}-{hash_of(inputs)}.safetensors"
    return cache_folder() / "experts" / name


@dataclass
class _Best:
    """The actor that did best so far, and how each did."""

    actor: dict[str, Tensor]
    value: float
    curve: list[list[float]]
    """After how many steps the actor returned how much, on average of the validation episodes."""


def train(
    settings: Settings, folder: Path, progress: Callable[[float, str], None] = lambda _, __: None
) -> dict[str, Any]:
    """Train an expert, write its weights and its JSON to `folder`, and return what the JSON says.

    A training that was interrupted goes on from its checkpoint, which lies in the cache. Where an expert
    follows from that of another task by a symmetry, that one is trained, and measured on the task asked for.

    Args:
        settings: What the weights follow from.
        folder: Where to write.
        progress: Called after each segment with the number of steps and how it stands.

    Raises:
        LookupError: No task has this name; the nearest one is named.
        ExpertError: The checkpoint cannot be read; the message names it.
    """
    torch.set_num_threads(1)
    symmetry = SYMMETRIES.get(settings.task)
    trained = settings if symmetry is None else dataclasses.replace(settings, task=symmetry.of)
    best = _train(trained, progress)
    expert = _expert(best.actor) if symmetry is None else symmetry.apply(_expert(best.actor))
    return _ship(settings, expert, best.curve, folder)


def _train(settings: Settings, progress: Callable[[float, str], None]) -> _Best:
    """Return the best actor of a training, begun or gone on with."""
    world = TrainingWorld(
        settings.task, lambda number: derive_seed("expert", settings.task, "training", settings.seed, number)
    )
    path = checkpoint_path(settings)
    with seeded("expert", settings.task, settings.seed, "weights"):
        learner = _learner(settings, world)
    best = _Best(_actor(learner, world), -math.inf, [])
    if path.exists():
        best = _read_checkpoint(learner, path)
        progress(learner.num_timesteps, f"goes on after {learner.num_timesteps:,} steps, from {path}")
        if learner.num_timesteps > settings.steps:
            raise ExpertError(
                f"{path} has {learner.num_timesteps:,} steps, more than {settings.steps:,}. Ask for as many, "
                "or delete it, and the training begins again."
            )
    while learner.num_timesteps < settings.steps:
        begin = time.monotonic()
        world.number = learner.num_timesteps // HORIZON
        learner._last_obs = None  # so that `learn` resets the world: segments are whole episodes
        with seeded("expert", settings.task, settings.seed, learner.num_timesteps):
            learner.action_space.seed(derive_seed("explore", settings.seed, learner.num_timesteps))
            learner.learn(settings.segment, reset_num_timesteps=False)
        value = float(
            returns(_expert(_actor(learner, world)), settings.task, "validation", VALIDATION_EPISODES).mean()
        )
        best.curve.append([learner.num_timesteps, round(value, 3)])
        if value >= best.value:
            best = _Best(_actor(learner, world), value, best.curve)
        _write_checkpoint(learner, best, path)
        pace = settings.segment / (time.monotonic() - begin)
        progress(
            settings.segment,
            f"{learner.num_timesteps:,} of {settings.steps:,} steps, return {value:.1f} of {HORIZON}, "
            f"best {best.value:.1f}, {pace:.0f} steps/s",
        )
    return best


def _learner(settings: Settings, world: TrainingWorld) -> WrittenOutSAC:
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


def _actor(learner: WrittenOutSAC, world: TrainingWorld) -> dict[str, Tensor]:
    """Return a copy of the layers that lead from what dm_control observes to the mean action."""
    state = learner.policy.actor.state_dict()
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


def _tensors(learner: WrittenOutSAC) -> Iterator[tuple[str, Tensor]]:
    """Yield all that a training goes on from, by name, in memory that is shared with it."""
    yield from ((f"policy.{name}", value) for name, value in learner.policy.state_dict().items())
    assert learner.log_ent_coef is not None
    assert learner.replay_buffer is not None
    yield "log_ent_coef", learner.log_ent_coef.data
    yield from ((f"moments.{name}", torch.from_numpy(values)) for name, values in learner.moments())
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        yield (
            f"replay.{name}",
            torch.from_numpy(getattr(learner.replay_buffer, name)[: learner.num_timesteps]),
        )


def _write_checkpoint(learner: WrittenOutSAC, best: _Best, path: Path) -> None:
    """Write one file in one step, so that a kill leaves the old one or the new one."""
    tensors = {name: value.clone() for name, value in _tensors(learner)}  # none may share memory
    tensors |= {f"best.{name}": value for name, value in best.actor.items()}
    words = {"steps": learner.num_timesteps, "updates": learner._n_updates, "value": best.value}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    save_file(tensors, partial, metadata={"training": json.dumps(words | {"curve": best.curve})})
    partial.replace(path)


def _read_checkpoint(learner: WrittenOutSAC, path: Path) -> _Best:
    """Put a learner into the state that was written, and return the best actor so far.

    Raises:
        ExpertError: The file is torn, or not one of such a training.
    """
    try:
        with safe_open(path, "pt") as file:
            words = json.loads(file.metadata()["training"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        learner.num_timesteps = int(words["steps"])
        learner.resumed(int(words["updates"]))
        for name, value in _tensors(learner):
            value.copy_(tensors[name])
        actor = {
            f"{number}.{kind}": tensors[f"best.{number}.{kind}"]
            for number in range(3)
            for kind in ("weight", "bias")
        }
        best = _Best(actor, float(words["value"]), list(words["curve"]))
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, SafetensorError) as error:
        raise ExpertError(
            f"{path} is no checkpoint of this training ({error}). Delete it, and the training begins again."
        ) from error
    assert learner.replay_buffer is not None
    learner.replay_buffer.pos = learner.num_timesteps
    return best


def _ship(settings: Settings, expert: Expert, curve: list[list[float]], folder: Path) -> dict[str, Any]:
    """Measure an expert, write its files, and return what the JSON says."""
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
    (folder / f"{task}.safetensors").write_bytes(content)
    text = json.dumps(card, indent=1) + "\n"
    (folder / f"{task}.json").write_text(text, encoding="utf-8", newline="\n")
    return card
