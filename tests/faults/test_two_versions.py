"""Two versions of the same demonstrations in one folder, which several processes read at once."""

import dataclasses
import multiprocessing
import random
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import same_demonstrations

from clbench.data.demonstrations import collect, dataset_folder, read_dataset
from clbench.spec.registry import load_scenario

PROCESSES, LOADS = 4, 250

TOY = load_scenario("clbench.testing:clbench/Toy-v0")
TASK = TOY.target[0]
VERSIONS = [dataclasses.replace(TOY.budget, noisy_demonstrations=share) for share in (0.2, 0.6)]
"""Two budgets with equally many demonstrations, so that only their contents tell them apart."""


def _load(seed: int) -> Counter[str]:
    """Load one or the other version many times, and count how often it was the right one."""
    chance = random.Random(seed)
    expected = [collect(TASK, budget) for budget in VERSIONS]
    came: Counter[str] = Counter()
    for _ in range(LOADS):
        version = chance.randrange(len(VERSIONS))
        found = read_dataset(dataset_folder(TASK, VERSIONS[version]))
        came["right" if same_demonstrations(found, expected[version]) else "wrong"] += 1
    return came


@pytest.mark.slow
def test_two_versions_of_demonstrations_are_never_mistaken_for_each_other(
    empty_caches: Path, record_property: Callable[[str, object], None]
) -> None:
    assert not same_demonstrations(*(collect(TASK, budget) for budget in VERSIONS))
    with multiprocessing.get_context("spawn").Pool(PROCESSES) as pool:
        came = sum(pool.map(_load, range(PROCESSES)), Counter())
    record_property("counts", dict(came))
    assert came == {"right": PROCESSES * LOADS}
