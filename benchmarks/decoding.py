"""Decoders of a discrete-diffusion policy: success, forwards and time, `python benchmarks/decoding.py`.

The teacher is the policy pretrained on Fetch-v1; students with blocks of 1, 2 and 4 steps learn from it in a
tenth of its steps. Success counts on the skills' validation episodes, with one teacher for each seed. For
time, decoders of the first seed take turns on chunks of one observation each, from the demonstrations; a
ratio compares two decoders in one round. The board and claim F6 read leaderboard/decoding.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ratios import median_ratio, take_turns
from result_files import write_results
from rich.progress import track
from torch import Tensor

from clbench.base.seeding import torch_generator
from clbench.data.demonstrations import Demonstrations, load_demonstrations
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.distillation import discrete_head, distilled
from clbench.learning.optimise import deterministic
from clbench.learning.pretraining import pretrained_policy
from clbench.policy.batch import Batch
from clbench.policy.decoding import (
    EASY_FIRST_STEPS,
    IN_SEQUENCE,
    Kept,
    Thresholds,
    Work,
    easy_first,
    pipelined,
)
from clbench.policy.discrete import DiscreteDiffusionHead
from clbench.policy.policy import Policy, PolicyConfig
from clbench.spec.registry import load_scenario

SCENARIO = "clbench/Fetch-v1"
BOARD = Path(__file__).parents[1] / "leaderboard"
PEER = f"easy first, {EASY_FIRST_STEPS} forwards"
PIPELINE = "pipeline, blocks of 1 step"
WIDTHS = (96, 192, 384, 768, 1536, 3072)
"""Widths of policies whose forwards are timed, with initial weights."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A policy with a decoder."""

    policy: Policy
    decode: Callable[..., Tensor]
    """Decoder of a chunk, which reports its work."""
    decode_many: Callable[..., Tensor] | None = None
    """Decoder of many chunks at a time that gives the same tokens; None for `decode`."""
    is_pipeline: bool = False
    """Whether it is what Fast-dVLA proposes: the pipeline of a distilled student with kept keys."""


def entries(teacher: Policy, students: dict[int, Policy]) -> dict[str, Entry]:
    """Return the decoders by name."""
    kept = partial(pipelined, cached=True)
    return {
        PEER: Entry(teacher, easy_first),
        "one forward": Entry(teacher, partial(easy_first, steps=1)),
        "one block, half of the tokens per forward": Entry(teacher, pipelined),
        "blocks of 1 step in sequence": Entry(
            students[1], partial(kept, thresholds=IN_SEQUENCE), partial(pipelined, thresholds=IN_SEQUENCE)
        ),
        **{
            f"pipeline, blocks of {block} step{'s' if block > 1 else ''}": Entry(
                student, kept, pipelined, is_pipeline=True
            )
            for block, student in students.items()
        },
        f"{PIPELINE}, tau_conf 0.25": Entry(
            students[1],
            partial(kept, thresholds=Thresholds(confidence=0.25)),
            partial(pipelined, thresholds=Thresholds(confidence=0.25)),
        ),
        f"{PIPELINE}, no kept keys": Entry(students[1], pipelined),
        f"{PIPELINE}, teacher with stale keys": Entry(teacher, partial(kept, block=1)),
    }


@contextmanager
def decoding(entry: Entry, decode: Callable[..., Tensor] | None = None) -> Iterator[Policy]:
    """Let the policy of an entry act with its decoder, or with another one."""
    head = discrete_head(entry.policy)
    own, head.decoder = head.decoder, decode or entry.decode
    try:
        yield entry.policy
    finally:
        head.decoder = own


def successes(entry: Entry, episodes: int, seed: int) -> list[bool]:
    """Return the outcomes of the skills' validation episodes, in the same order for every entry."""
    scenario = load_scenario(SCENARIO)
    each = -(-episodes // len(scenario.retained))
    budget = dataclasses.replace(scenario.budget, validation_episodes=each)
    evaluator = Evaluator(dataclasses.replace(scenario, budget=budget), seed)
    with decoding(entry, entry.decode_many) as policy, deterministic():
        outcomes = evaluator.evaluate(policy, scenario.retained, "validation")
    evaluator.close()
    return [one.success for one in outcomes]


def difference(ours: list[bool], theirs: list[bool], generator: np.random.Generator) -> list[float]:
    """Return the difference of success in paired episodes, and its 95 % bootstrap interval."""
    apart = np.subtract(ours, theirs, dtype=np.float64)
    drawn = generator.choice(apart, size=(2000, len(apart))).mean(axis=1)
    return [round(float(value), 4) for value in (apart.mean(), *np.percentile(drawn, [2.5, 97.5]))]


def seconds(entry: Entry, batch: Batch, _: int) -> float:
    """Return the time in which the policy acts on each observation of a batch, one by one."""
    with decoding(entry) as policy:
        begin = time.perf_counter()
        for row in range(len(batch)):
            one = batch[row : row + 1]
            policy.act(one.state, one.words, one.noise)
        return time.perf_counter() - begin


def work_of(entry: Entry, batch: Batch) -> list[Work]:
    """Return the forwards of each chunk."""
    found = [Work() for _ in range(len(batch))]
    for row, work in enumerate(found):
        one = batch[row : row + 1]
        with decoding(entry, partial(entry.decode, work=work)) as policy:
            policy.act(one.state, one.words, one.noise)
    return found


def by_width(spans: list[tuple[int, int]], rounds: int, generator: np.random.Generator) -> dict[str, Any]:
    """Return times of the head with blocks of one step as ratios, by width of the policy.

    `chunk`: the time of easy-first decoding divided by that of the given forwards with kept keys. `forward`:
    the time of a forward of all tokens divided by that of a forward of one block.
    """
    return {
        str(width): {
            name: median_ratio(ratios, generator)
            for name, ratios in _at(width, spans, rounds, generator).items()
        }
        for width in WIDTHS
    }


@torch.inference_mode()
def _at(
    width: int, spans: list[tuple[int, int]], rounds: int, generator: np.random.Generator
) -> dict[str, list[float]]:
    """Return the ratios of `by_width` in each round, at one width."""
    config = PolicyConfig(25, 4, width=width)
    sizes = (config.action_size, config.chunk, width, config.layers, config.heads)
    whole, in_blocks = DiscreteDiffusionHead(*sizes), DiscreteDiffusionHead(*sizes, block=1)
    hidden = [torch.randn(1, 17, width) for _ in range(config.layers)]
    mask = torch.ones(1, 1, 1, 17, dtype=torch.bool)
    tokens = torch.full((1, whole.length), whole.bins)
    block, keys = tokens[:, : config.action_size], in_blocks.begin(hidden)
    works: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
        "chunk": (lambda: easy_first(whole, hidden, mask), lambda: _repeat(in_blocks, hidden, mask, spans)),
        "forward": (
            lambda: [whole.logits(tokens, hidden, mask) for _ in range(EASY_FIRST_STEPS)],
            lambda: [in_blocks.go_on(block, 0, keys, mask) for _ in range(EASY_FIRST_STEPS)],
        ),
    }
    found = {}
    for name, (peer, ours) in works.items():
        pair = {"peer": partial(_time, peer), "ours": partial(_time, ours)}
        taken = take_turns(pair, rounds, generator, f"width {width}, {name}")
        found[name] = [one["peer"] / one["ours"] for one in taken]
    return found


def _time(work: Callable[[], object], _: int) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _repeat(
    head: DiscreteDiffusionHead, hidden: list[Tensor], mask: Tensor, spans: list[tuple[int, int]]
) -> None:
    """Do the forwards of a decoded chunk again, on tokens that are all masked."""
    forward = Kept(head, hidden, mask, head.block)
    tokens = torch.full((1, head.length), head.bins)
    complete = [first // forward.size for first, _ in spans[1:]] + [0]
    for (first, end), after in zip(spans, complete, strict=True):
        forward(tokens[:, first:end], after).softmax(dim=2).max(dim=2)


def entries_of(seed: int) -> tuple[dict[str, Entry], Demonstrations]:
    """Return the decoders of the policy pretrained with `seed`, and the demonstrations of its skills."""
    scenario = load_scenario(SCENARIO).with_policy("discrete_diffusion")
    teacher, _ = pretrained_policy(scenario, seed)
    data = {task.name: load_demonstrations(task, scenario, teacher.config) for task in scenario.pretrained}
    every = Demonstrations.cat(list(data.values()))
    students = {
        block: distilled(teacher, every, scenario.budget, torch_generator("distillation", seed), block)
        for block in track((1, 2, 4), description=f"distillation, seed {seed}")
    }
    return entries(teacher, students), Demonstrations.cat([data[task.name] for task in scenario.retained])


def timed(
    found: dict[str, Entry], batch: Batch, rounds: int, generator: np.random.Generator
) -> dict[str, list[float]]:
    """Return the seconds per chunk of each decoder in each round."""
    works = {name: partial(seconds, entry, batch) for name, entry in found.items()}
    taken = take_turns(works, rounds, generator, "time")
    return {name: [one[name] / len(batch) for one in taken] for name in found}


def parse() -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=3, help="number of pretrained policies")
    parser.add_argument("--episodes", type=int, default=200, help="episodes of each decoder and seed")
    parser.add_argument("--rounds", type=int, default=15, help="rounds in which decoders take turns")
    parser.add_argument("--chunks", type=int, default=40, help="chunks of each decoder in a round")
    return parser.parse_args()


def main() -> None:
    """Measure, and write the results."""
    options = parse()
    torch.set_num_threads(1)
    generator = np.random.default_rng(0)
    outcomes: dict[str, list[bool]] = {}
    for seed in reversed(range(options.seeds)):
        found, skills = entries_of(seed)
        for name in track(found, description=f"success, seed {seed}"):
            outcomes[name] = outcomes.get(name, []) + successes(found[name], options.episodes, seed)
    batch = skills.sample(options.chunks, torch_generator("benchmark", "decoding"))
    works = {name: work_of(entry, batch) for name, entry in found.items()}
    times = timed(found, batch, options.rounds, generator)
    rows = {
        name: {
            "is_pipeline": found[name].is_pipeline,
            "success": round(float(np.mean(outcomes[name])), 4),
            "success_difference": difference(outcomes[name], outcomes[PEER], generator),
            "forwards": round(float(np.mean([len(work.spans) for work in works[name]])), 2),
            "tokens": round(float(np.mean([work.tokens for work in works[name]])), 2),
            "milliseconds": round(1000 * float(np.median(times[name])), 2),
            "speed_up": median_ratio(np.divide(times[PEER], times[name]).tolist(), generator),
        }
        for name in found
    }
    typical = sorted(works[PIPELINE], key=lambda work: work.tokens)[len(batch) // 2].spans
    values = {
        "scenario": SCENARIO,
        "seeds": options.seeds,
        "episodes": len(outcomes[PEER]),
        "rounds": options.rounds,
        "decoders": rows,
        "by_width": by_width(typical, options.rounds, generator),
    }
    write_results("decoding", values, BOARD)


if __name__ == "__main__":
    main()
