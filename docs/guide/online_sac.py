"""Stable-Baselines3's SAC learns a scenario by trial and error, stage by stage, and leaves a record.

    python docs/guide/online_sac.py clbench/PointMaze-v1 --seeds 3
    python docs/guide/online_sac.py clbench/PointMaze-v1 --seeds 3 --replay

SAC continues to train from task to task, and acts in eight environments at once. `USUAL` has what differs
from the defaults of Stable-Baselines3, and `SETTINGS` what differs from both on a scenario. Each stage begins
with the entropy coefficient at 1 and with a twentieth of its steps at random, so that SAC explores again. The
replay buffer is emptied at each stage, so that only the weights remember; with --replay it keeps the
transitions of all stages. Word ids are names, not amounts, and go through an embedding; pictures go through a
convolutional network. A seed that has a record is skipped; a seed that was stopped starts again. On the same
machine, the same seed gives the same result.
"""

from __future__ import annotations

import argparse
import functools
from pathlib import Path
from typing import Any

import gymnasium
import torch
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv

import clbench
from clbench.records.paths import RECORDS
from clbench.scoring.scores import Scores

ENVIRONMENTS = 8
"""Environments that step together."""
RANDOM = 0.05
"""Share of random steps, at the beginning of each stage."""
USUAL = {"gradient_steps": 2, "width": 128}
"""Gradient steps for each step of the eight environments, and units of each hidden layer."""
SETTINGS: dict[str, dict[str, Any]] = {
    "clbench/DMControl-v0": {
        "gradient_steps": 8,
        "width": 64,
        "learning_rate": 1e-3,
        "gamma": 0.98,
        "tau": 0.01,
    },
}
"""Settings of scenarios on which the usual ones learn little. Those of DMControl are the settings of the
scenario's experts: its rewards are 0 nearly everywhere, and the usual settings did not learn a point mass."""


class Observed(BaseFeaturesExtractor):
    """Features: the state, the mean of the learned vectors of the instruction's words, and of any picture."""

    def __init__(self, space: spaces.Dict, width: int = 16, picture_width: int = 64) -> None:
        state, words, picture = (space.spaces.get(name) for name in ("state", "instruction", "image"))
        assert isinstance(state, spaces.Box)
        assert isinstance(words, spaces.Box)
        super().__init__(space, state.shape[0] + width + (picture_width if picture else 0))
        self.words = torch.nn.Embedding(int(words.high.max()) + 1, width, padding_idx=0)
        self.picture = NatureCNN(picture, picture_width) if picture else None

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the features (B, F)."""
        ids = observations["instruction"].long()
        words = self.words(ids).sum(dim=1) / (ids > 0).sum(dim=1, keepdim=True)
        pictures = [self.picture(observations["image"])] if self.picture else []
        return torch.cat([observations["state"], words, *pictures], dim=1)


def learn(scenario: str, seed: int, steps: int, replay: bool, records: Path) -> None:
    """Train one agent through all stages, and evaluate it after each."""
    method = "sac_replay" if replay else "sac"
    stages = len(clbench.load_scenario(scenario).target) + 1
    if clbench.next_stage(scenario, method=method, seed=seed, records=records) == stages:
        print(f"{method} seed {seed} has a record already")
        return
    tuned = {**USUAL, **SETTINGS.get(scenario, {})}
    settings = {
        "steps_per_stage": steps,
        "environments": ENVIRONMENTS,
        "random_share": RANDOM,
        **tuned,
        "replay_buffer": "kept" if replay else "emptied at each stage",
        "words": "embedded",
    }
    width = tuned.pop("width")
    agent: SAC | None = None
    for stage in range(stages):
        make = functools.partial(gymnasium.make, scenario, instruction="tokens", stage=stage)
        envs = DummyVecEnv([make] * ENVIRONMENTS)
        if agent is None:
            agent = SAC(
                "MultiInputPolicy",
                envs,
                seed=1000 * seed,
                policy_kwargs={"features_extractor_class": Observed, "net_arch": [width, width]},
                buffer_size=steps * stages if replay else steps,
                learning_starts=round(RANDOM * steps),
                device="cpu",
                **tuned,
            )
        agent.set_env(envs)
        agent.set_random_seed(1000 * seed + 10 * stage)  # its eight environments count up from it
        assert agent.replay_buffer is not None
        if not replay:
            agent.replay_buffer.reset()
        assert isinstance(agent.log_ent_coef, torch.Tensor)
        with torch.no_grad():
            agent.log_ent_coef.zero_()
        agent.learn(steps)
        record = clbench.evaluate_agent(
            agent, envs, method=method, seed=seed, settings=settings, records=records
        )
        envs.close()
        scores = Scores.from_record(record, partial=True)  # later stages are still to come
        success = scores.success[stage].mean(axis=-1)
        rates = ", ".join(
            f"{task} {rate:.2f}" for task, rate in zip(scores.layout.tasks, success, strict=True)
        )
        print(f"{method} seed {seed}, stage {stage}: {rates}", flush=True)


def main() -> None:
    """Train the agents that have no record yet, one after the other."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario", help="Gymnasium id of the scenario, for example clbench/Fetch-v1")
    parser.add_argument("--seeds", type=int, default=4, help="number of seeds")
    parser.add_argument("--first-seed", type=int, default=0, help="first seed")
    parser.add_argument("--steps", type=int, default=40_000, help="environment steps per stage")
    parser.add_argument("--replay", action="store_true", help="keep the transitions of earlier stages")
    parser.add_argument("--records", type=Path, default=RECORDS, help="folder of the records")
    wanted = parser.parse_args()
    if wanted.steps < 1:
        parser.error("--steps must be at least 1")
    torch.set_num_threads(1)  # small networks: more threads gain nothing, and may add up in another order
    for seed in range(wanted.first_seed, wanted.first_seed + wanted.seeds):
        learn(wanted.scenario, seed, wanted.steps, wanted.replay, wanted.records)


if __name__ == "__main__":
    main()
