"""SAC of stable-baselines3 with its gradient step written out: the same update at a fifth of the cost.

Networks of two layers of 64 units cost next to nothing to compute. PyTorch's 11 ms for a gradient step, on
one slow core, are the overhead of recording and calling 700 operations. This module computes the same numbers
in NumPy, in the memory of stable-baselines3's own parameters. Everything else is stable-baselines3's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC

Array = NDArray[np.float32]

EPSILON = np.float32(1e-6)
"""Constant that SAC adds inside the logarithm of a squashed action's density."""


class _Adam:
    """The parameters of networks of the same shape in one block of memory, with Adam's moments.

    Args:
        alike: Parameters of each network; those at the same position become one array (networks, ...).
        rate: Step size.
    """

    def __init__(self, alike: Sequence[Sequence[torch.Tensor]], rate: float) -> None:
        columns = list(zip(*alike, strict=True))
        sizes = [sum(parameter.numel() for parameter in column) for column in columns]
        self.values = np.empty(sum(sizes), np.float32)
        self.gradient, self.first, self.second = (np.zeros_like(self.values) for _ in range(3))
        self.rate, self.step_count = rate, 0
        self.parts, self.gradients = [], []
        for column, end, size in zip(columns, np.cumsum(sizes), sizes, strict=True):
            shape = (len(alike), *column[0].shape)
            part = self.values[end - size : end].reshape(shape)
            for parameter, place in zip(column, part, strict=True):
                place[...] = parameter.detach().numpy()
                parameter.data = torch.from_numpy(place)
            self.parts.append(part)
            self.gradients.append(self.gradient[end - size : end].reshape(shape))

    def step(self) -> None:
        """Move the parameters against `gradient`."""
        self.step_count += 1
        self.first += (self.gradient - self.first) * np.float32(0.1)
        self.second += (self.gradient * self.gradient - self.second) * np.float32(0.001)
        size = self.rate / (1 - 0.9**self.step_count)
        scale = math.sqrt(1 - 0.999**self.step_count)
        self.values -= np.float32(size) * self.first / (np.sqrt(self.second) / np.float32(scale) + 1e-8)


@dataclass
class _Pass:
    """Values that a forward pass keeps for the backward pass; the first axis is the network."""

    inputs: Array
    hidden: list[Array]
    """Values after each rectifier."""
    output: Array


def _forward(parts: list[Array], inputs: Array) -> _Pass:
    """Run networks of linear layers with rectifiers between them on inputs (B, in)."""
    values, hidden = inputs[None], []
    for layer in range(0, len(parts) - 2, 2):
        values = values @ parts[layer].swapaxes(1, 2)
        values += parts[layer + 1][:, None]
        np.maximum(values, 0, out=values)
        hidden.append(values)
    return _Pass(inputs, hidden, values @ parts[-2].swapaxes(1, 2) + parts[-1][:, None])


def _backward(parts: list[Array], run: _Pass, slope: Array, gradients: list[Array] | None) -> Array:
    """Return the gradient of the inputs (networks, B, in), given the outputs' gradient (networks, B, out).

    If `gradients` is given, the gradients of the parameters are written there.
    """
    for layer in range(len(parts) - 2, -1, -2):
        below = run.hidden[layer // 2 - 1] if layer else None
        if gradients is not None:
            np.matmul(
                slope.swapaxes(1, 2), run.inputs[None] if below is None else below, out=gradients[layer]
            )
            slope.sum(axis=1, out=gradients[layer + 1])
        slope = slope @ parts[layer]
        if below is not None:
            slope *= below > 0
    return slope


class WrittenOutSAC(SAC):
    """SAC with hidden layers of rectifiers, two critics, and a learned weight of the entropy."""

    def _setup_model(self) -> None:
        super()._setup_model()
        assert self.log_ent_coef is not None
        rate, size = float(self.lr_schedule(1)), self.action_space.shape[0]  # type: ignore[index]
        # one head for both outputs: the mean, then the logarithm of the deviation
        deviations = cast(torch.nn.Module, self.actor.log_std)  # declared as a parameter
        heads = list(zip(self.actor.mu.parameters(), deviations.parameters(), strict=True))
        joined = [torch.cat([mean.data, deviation.data]) for mean, deviation in heads]
        self._actor_adam = _Adam([[*self.actor.latent_pi.parameters(), *joined]], rate)
        for (mean, deviation), whole in zip(heads, joined, strict=True):
            mean.data, deviation.data = whole[:size], whole[size:]
        self._critic_adam = _Adam([list(network.parameters()) for network in self.critic.q_networks], rate)
        self._entropy_adam = _Adam([[self.log_ent_coef]], rate)
        self._adams = (self._actor_adam, self._critic_adam, self._entropy_adam)
        self._target = _Adam([list(network.parameters()) for network in self.critic_target.q_networks], 0.0)

    def moments(self) -> Iterator[tuple[str, Array]]:
        """Yield the moments of the optimisers by name; their numbers of steps are `_n_updates`."""
        for name, adam in zip(("actor", "critic", "entropy"), self._adams, strict=True):
            yield f"{name}.first", adam.first
            yield f"{name}.second", adam.second

    def resumed(self, updates: int) -> None:
        """Restore the number of gradient steps after an interruption."""
        self._n_updates = updates
        for adam in self._adams:
            adam.step_count = updates

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Take gradient steps, each on a batch from the replay buffer."""
        assert self.replay_buffer is not None
        for _ in range(gradient_steps):
            data = self.replay_buffer.sample(batch_size)
            self._step(
                *(
                    getattr(data, name).numpy()
                    for name in ("observations", "actions", "rewards", "next_observations", "dones")
                )
            )
        self._n_updates += gradient_steps

    def _act(self, observations: Array) -> tuple[_Pass, Array, Array, Array, Array]:
        """Return the forward pass, deviation, noise and action (B, A), and the action's log density (B,)."""
        run = _forward(self._actor_adam.parts, observations)
        size = run.output.shape[2] // 2
        deviation = np.exp(np.clip(run.output[0, :, size:], -20, 2))
        noise = torch.randn(deviation.shape).numpy()
        action = np.tanh(run.output[0, :, :size] + deviation * noise)
        density = -0.5 * noise * noise - np.log(deviation) - np.float32(0.5 * math.log(2 * math.pi))
        return run, deviation, noise, action, (density - np.log(1 - action * action + EPSILON)).sum(axis=1)

    def _step(self, observations: Array, actions: Array, rewards: Array, after: Array, dones: Array) -> None:
        count, size = actions.shape
        run, deviation, noise, action, density = self._act(observations)
        weight = np.exp(self._entropy_adam.values[0])
        _, _, _, next_action, next_density = self._act(after)

        self._entropy_adam.gradient[0] = -(density.mean() + float(self.target_entropy))
        self._entropy_adam.step()

        critics, targets = self._critic_adam, self._target
        value = _forward(targets.parts, np.concatenate([after, next_action], axis=1)).output.min(axis=0)[:, 0]
        goal = rewards[:, 0] + (1 - dones[:, 0]) * np.float32(self.gamma) * (value - weight * next_density)
        judged = _forward(critics.parts, np.concatenate([observations, actions], axis=1))
        _backward(
            critics.parts, judged, (judged.output - goal[:, None]) / np.float32(count), critics.gradients
        )
        critics.step()

        judged = _forward(critics.parts, np.concatenate([observations, action], axis=1))
        least = judged.output.argmin(axis=0)[None] == np.arange(len(judged.output))[:, None, None]
        slope = _backward(critics.parts, judged, least * np.float32(-1 / count), None).sum(axis=0)[:, -size:]
        room = 1 - action * action
        by_mean = slope * room + (weight / count) * 2 * action * room / (room + EPSILON)
        by_deviation = by_mean * deviation * noise - weight / count
        free = (run.output[0, :, size:] > -20) & (run.output[0, :, size:] < 2)
        whole = np.concatenate([by_mean, by_deviation * free], axis=1, dtype=np.float32)
        _backward(self._actor_adam.parts, run, whole[None], self._actor_adam.gradients)
        self._actor_adam.step()

        targets.values += np.float32(self.tau) * (critics.values - targets.values)
