"""Decoders of a discrete-diffusion policy: success, forwards and time, `python benchmarks/decoding.py`.

The teacher is the policy pretrained on Fetch-v1; students with blocks of 1, 2 and 4 steps learn from it in a
tenth of its steps. Success counts on the skills' validation episodes. For time, decoders take turns on chunks
of one observation each, from the demonstrations; a ratio compares two decoders in one round.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
from ratios import median_ratio
from result_files import write_results
from rich.progress import track
from torch import Tensor

from clbench.base.seeding import derive_seed, torch_generator
from clbench.data.demonstrations import Demonstrations, load_demonstrations
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.distillation import discrete_head, distilled
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.trainer import repeatable
from clbench.policy.batch import Batch
from clbench.policy.decoding import EASY_FIRST_STEPS, IN_SEQUENCE, Kept, Work, easy_first, pipelined
from clbench.policy.discrete import DiscreteDiffusionHead
from clbench.policy.policy import Policy, PolicyConfig
from clbench.spec.registry import load_scenario

SCENARIO = "clbench/Fetch-v1"
PEER = f"easy first, {EASY_FIRST_STEPS} forwards"
PIPELINE = "pipeline, blocks of 1 step"
WIDTHS = (96, 192, 384, 768, 1536)
"""Widths of policies whose forwards are timed, with initial weights."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A policy with a decoder."""

    policy: Policy
    decode: Callable[..., Tensor]
    """Decoder of a chunk, which reports its work."""
    decode_many: Callable[..., Tensor] | None = None
    """Decoder of many chunks at a time that gives the same tokens; None for `decode`."""


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
            f"pipeline, blocks of {block} step{'s' if block > 1 else ''}": Entry(student, kept, pipelined)
            for block, student in students.items()
        },
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


def success(entry: Entry, episodes: int, seed: int) -> float:
    """Return the success on validation episodes of the skills."""
    scenario = load_scenario(SCENARIO)
    each = -(-episodes // len(scenario.retained))
    budget = dataclasses.replace(scenario.budget, validation_episodes=each)
    evaluator = Evaluator(dataclasses.replace(scenario, budget=budget), seed)
    with decoding(entry, entry.decode_many) as policy, repeatable("cpu"):
        outcomes = evaluator.evaluate(policy, scenario.retained, "validation")
    evaluator.close()
    return sum(one.success for one in outcomes) / len(outcomes)


def seconds(entry: Entry, batch: Batch) -> float:
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
    """Return the time of easy-first decoding as a ratio to that of the spans, by width of the policy."""
    found = {}
    for width in WIDTHS:
        config = PolicyConfig(25, 4, width=width)
        sizes = (config.action_size, config.chunk, width, config.layers, config.heads)
        whole, in_blocks = DiscreteDiffusionHead(*sizes), DiscreteDiffusionHead(*sizes, block=1)
        hidden = [torch.randn(1, 17, width) for _ in range(config.layers)]
        mask = torch.ones(1, 1, 1, 17, dtype=torch.bool)
        ratios = []
        with torch.inference_mode():
            for _ in range(rounds + 1):
                begin = time.perf_counter()
                easy_first(whole, hidden, mask)
                middle = time.perf_counter()
                _repeat(in_blocks, hidden, mask, spans)
                ratios.append((middle - begin) / (time.perf_counter() - middle))
        found[str(width)] = median_ratio(ratios[1:], generator)
    return found


def _repeat(
    head: DiscreteDiffusionHead, hidden: list[Tensor], mask: Tensor, spans: list[tuple[int, int]]
) -> None:
    """Do the forwards of a decoded chunk again, on tokens that are all masked."""
    forward = Kept(head, hidden, mask, head.block)
    tokens = torch.full((1, head.length), head.bins)
    complete = [first // forward.size for first, _ in spans[1:]] + [0]
    for (first, end), after in zip(spans, complete, strict=True):
        forward(tokens[:, first:end], after).softmax(dim=2).max(dim=2)


def parse() -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="seed of the pretrained policy")
    parser.add_argument("--episodes", type=int, default=200, help="episodes on the skills for each decoder")
    parser.add_argument("--rounds", type=int, default=15, help="rounds in which decoders take turns")
    parser.add_argument("--chunks", type=int, default=40, help="chunks of each decoder in a round")
    return parser.parse_args()


def main() -> None:
    """Measure, and write the results."""
    options = parse()
    torch.set_num_threads(1)
    scenario = load_scenario(SCENARIO).with_policy("discrete_diffusion")
    teacher, _ = pretrained_policy(scenario, options.seed)
    data = {task.name: load_demonstrations(task, scenario, teacher.config) for task in scenario.pretrained}
    every = Demonstrations.cat(list(data.values()))
    skills = Demonstrations.cat([data[task.name] for task in scenario.retained])
    students = {
        block: distilled(
            teacher, every, scenario.budget, torch_generator("distillation", options.seed), block
        )
        for block in track((1, 2, 4), description="distillation")
    }
    batch = skills.sample(options.chunks, torch_generator("benchmark", "decoding"))
    found = entries(teacher, students)
    works = {name: work_of(entry, batch) for name, entry in found.items()}
    times: dict[str, list[float]] = {name: [] for name in found}
    for number in track(range(options.rounds + 1), description="time"):  # the first round warms up
        for name in sorted(found, key=lambda name: derive_seed("order", f"{name} {number}")):
            times[name].append(seconds(found[name], batch) / len(batch))
    generator = np.random.default_rng(0)
    rows = {}
    for name in track(found, description="success"):
        pairs = zip(times[PEER][1:], times[name][1:], strict=True)
        rows[name] = {
            "success": round(success(found[name], options.episodes, options.seed), 4),
            "forwards": float(np.mean([len(work.spans) for work in works[name]])),
            "tokens": float(np.mean([work.tokens for work in works[name]])),
            "milliseconds": round(1000 * float(np.median(times[name][1:])), 2),
            "speed_up": median_ratio([peer / own for peer, own in pairs], generator),
        }
    typical = sorted(works[PIPELINE], key=lambda work: work.tokens)[len(batch) // 2].spans
    write_results(
        "decoding",
        SCENARIO,
        {
            "episodes": options.episodes,
            "rounds": options.rounds,
            "decoders": rows,
            "speed_up_of_the_head_by_width": by_width(typical, options.rounds, generator),
        },
    )


if __name__ == "__main__":
    main()
