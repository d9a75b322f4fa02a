"""The fingerprint of a record: the software and hardware behind a score, down to the simulator's bits."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import subprocess
from functools import lru_cache
from importlib.metadata import packages_distributions, version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from clbench.base.dependencies import versions
from clbench.base.entry_points import resolve
from clbench.spec.policies import policy_source
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.observation import frame_hash

PACKAGES = (
    "clbench",
    "gymnasium",
    "minari",
    "mujoco",
    "numpy",
    "peft",
    "tokenizers",
    "torch",
)
"""Packages whose versions are in every record, in addition to the packages of the scenario's tasks."""

_ROLLOUT_STEPS = 50


def rollout_hash(world: str, task: str) -> str:
    """Return the hash of a fixed open-loop rollout of a world; it changes with the simulator.

    Args:
        world: Entry point of the environment.
        task: Name of the task that chooses the initial state.
    """
    with contextlib.closing(resolve(world)()) as environment:
        assert isinstance(environment.action_space, gymnasium.spaces.Box)
        generator = np.random.default_rng(0)
        low, high = environment.action_space.low, environment.action_space.high
        state, _ = environment.reset(seed=0, options={"task": task})
        digest = hashlib.sha256(np.asarray(state, np.float32).tobytes())
        for _ in range(_ROLLOUT_STEPS):
            state, *_ = environment.step(generator.uniform(low, high).astype(np.float32))
            digest.update(np.asarray(state, np.float32).tobytes())
    return digest.hexdigest()[:16]


def fingerprint(scenario: Scenario, device: str = "cpu") -> dict[str, Any]:
    """Return versions, commit, hardware, the rollout hash of every world of the scenario, and its definition.

    For a world with a camera, the hash of a picture is added under the name of the camera.

    Args:
        scenario: The scenario.
        device: Device on which the policy is computed, as PyTorch names it.
    """
    from clbench.evaluation.definition import definition  # imports torch, see `_hardware`

    packages = {*PACKAGES, *(package for task in scenario.tasks for package in task.packages)}
    worlds: dict[str, Task] = {}
    for task in scenario.tasks:
        worlds.setdefault(task.world, task)
    rollouts = {world: rollout_hash(world, task.name) for world, task in worlds.items()}
    frames = {task.camera: frame_hash(task) for task in worlds.values() if task.camera is not None}
    return {
        "versions": versions(packages),
        "python": platform.python_version(),
        "commit": _commit(),
        "hardware": _hardware(device),
        "rollouts": {**rollouts, **frames},
        "definition": definition(scenario),
    }


def describe_policy(scenario: Scenario, seed: int) -> dict[str, str | None]:
    """Return the entries of a fingerprint that describe a policy class of your own, by name.

    "policy" is the hash of its source, or None for a built-in policy. "weights" is there only for a class
    that brings pretrained weights. It is their hash, because the file that holds them may be replaced.
    """
    source = policy_source(scenario.policy)
    if source is None:
        return {"policy": None}
    from clbench.learning.pretraining import pretraining_inputs  # imports torch, see `_hardware`

    weights = pretraining_inputs(scenario, seed).get("weights")
    return {"policy": source, **({"weights": weights} if weights else {})}


def describe_agent(agent: Any) -> dict[str, Any]:
    """Return the class of an agent and the version of its package, None if it has no package."""
    kind = type(agent)
    packages = packages_distributions().get(kind.__module__.partition(".")[0], [])
    return {
        "class": f"{kind.__module__}:{kind.__qualname__}",
        "version": version(packages[0]) if packages else None,
    }


def _commit() -> dict[str, Any] | None:
    """Return the commit of the checkout that contains this file, and whether code was changed, or None."""
    folder = Path(__file__).resolve().parents[1]
    if not (folder.parent / ".git").exists():
        return None
    try:
        git = ["git", "-C", os.fspath(folder.parent)]
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        # runs write records and the table, which do not affect later runs
        code = ["clbench", "envs", "methods", "pyproject.toml", "constraints.txt"]
        changed = subprocess.run(
            [*git, "status", "--porcelain", "--", *code], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return {"id": head.stdout.strip(), "dirty": bool(changed.stdout.strip())}


def _hardware(device: str) -> dict[str, str]:
    """Return the hardware that affects rounding: processors of one name may have different instructions."""
    import torch  # takes seconds, for which code that only steps environments need not wait

    gpu = {"gpu": torch.cuda.get_device_name(device)} if torch.device(device).type == "cuda" else {}
    return {
        **gpu,
        "machine": platform.machine(),
        "system": platform.system(),
        "processor": _cpu_info("model name") or platform.processor(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "arithmetic": arithmetic_hash(),
    }


def arithmetic(device: str) -> dict[str, str]:
    """Return the hardware that determines a run's bits: a run that changes it midway cannot be repeated.

    The maker of the processor counts, because MKL, which multiplies PyTorch's matrices, runs other code on
    Intel's processors than on others with the same instructions.
    """
    hardware = {**_hardware(device), "maker": _cpu_info("vendor_id")}
    names = ("gpu", "machine", "maker", "instructions", "arithmetic")
    return {name: hardware[name] for name in names if name in hardware}


@lru_cache(maxsize=1)
def arithmetic_hash() -> str:
    """Return a hash of this processor's arithmetic in PyTorch: small layers after three steps of AdamW.

    Names do not determine the bits. Environment variables make MKL and PyTorch run other code on the same
    processor, and processors with the same instructions differ. The layers use what policies use: matrix
    products of two sizes, attention, normalisation, convolution, exponentials, sums and the fused optimiser.
    The computation takes 0.2 s.
    """
    import torch
    from torch import nn

    from clbench.learning.optimise import deterministic

    with deterministic(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        layers = nn.ModuleList(
            [
                nn.Conv2d(3, 128, 8, stride=8),
                nn.TransformerEncoderLayer(128, 4, 256, dropout=0.0, batch_first=True, norm_first=True),
                nn.Linear(128, 512),
                nn.Linear(512, 512),
            ]
        )
        images = torch.randn(16, 3, 40, 32)
        optimiser = torch.optim.AdamW(layers.parameters(), lr=1e-3, fused=True)
        for _ in range(3):
            optimiser.zero_grad()
            mapped = layers[0](images).flatten(2).transpose(1, 2)
            for layer in layers[1:]:
                mapped = layer(mapped)
            (mapped.tanh().square().mean() - mapped.log_softmax(-1).mean()).backward()
            nn.utils.clip_grad_norm_(layers.parameters(), 1.0)
            optimiser.step()
    weights = b"".join(value.numpy().tobytes() for value in layers.state_dict().values())
    return hashlib.sha256(weights).hexdigest()[:16]


def _cpu_info(field: str) -> str:
    """Return a field of Linux's description of the first processor, empty if there is none."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(field)), "")
