"""The section of the findings on smaller learning rates follows from made-up ladders."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest


def add_ladder(even_board: Callable[..., Path], kept: Mapping[float, Sequence[float]]) -> None:
    """Add plain fine-tuning, and its runs on a ladder: what each seed keeps, by factor of the rate."""
    for seed in range(4):
        even_board("sft", seed, 0.4)
    for factor, shares in kept.items():
        for seed, share in enumerate(shares):
            even_board("sft", seed, share, "ladder", step_factor=factor)


@pytest.mark.long
def test_the_ladder_tells_what_a_smaller_learning_rate_does(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    add_ladder(even_board, {})
    assert "smaller learning rate" not in page()
    add_ladder(even_board, {1.0: (0.2,) * 4, 0.1: (0.5,) * 4})
    text = page()
    assert "On Even-v1, plain fine-tuning at 0.1 times the scenario's learning rate keeps 0.30 [" in text
    assert "which is not certain" not in text
    assert re.search(
        r"\| plain fine-tuning at the scenario's learning rate \| 0\.20 \[.*?\], 4 seeds \|", text
    )
    assert re.search(
        r"\| plain fine-tuning at its best rate \| 0\.50 \[.*?\], 4 seeds at factor 0\.1, best of 2 \|", text
    )


def test_a_smaller_learning_rate_that_keeps_more_by_chance_is_not_called_certain(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    add_ladder(even_board, {1.0: (0.1, 0.5), 0.1: (0.5, 0.3)})
    text = page()
    found = re.search(r"keeps 0\.10 \[-0\.\d+, 0\.\d+\] more than at the scenario's learning rate(.*)", text)
    assert found
    assert found[1].startswith(", which is not certain, and learns 0.9")
    assert "What a smaller rate gains is therefore biased upwards" in text


@pytest.mark.parametrize(
    ("usual", "says", "cell"),
    [
        ({1.0: (0.2, 0.3)}, "0.1 times the scenario's learning rate keeps 0.35 [", r"0\.25 \[.*?\], 2 seeds"),
        ({}, "plain fine-tuning keeps most at 0.1 times the scenario's learning rate.\n", "-"),
    ],
)
def test_the_learning_rate_of_the_scenario_is_the_one_of_factor_1(
    usual: dict[float, Sequence[float]],
    says: str,
    cell: str,
    even_board: Callable[..., Path],
    page: Callable[[], str],
) -> None:
    add_ladder(even_board, {3.0: (0.1, 0.1), **usual, 0.1: (0.6, 0.6)})
    for factor, kept in ((3.0, 0.9), (1.0, 0.5)):
        for seed in range(2):
            even_board("finch", seed, kept, "ladder", step_factor=factor)
    text = page()
    assert says in text
    assert re.search(rf"\| plain fine-tuning at the scenario's learning rate \| {cell} \|", text)
    best = "best method without prior demonstrations at the scenario's learning rate"
    assert re.search(rf"\| {best} \| `finch` 0\.50 \[.*?\], 2 seeds, best of 1 method \|", text)


def test_a_difference_that_counts_more_seeds_than_the_ladder_says_so(
    even_board: Callable[..., Path], page: Callable[[], str]
) -> None:
    add_ladder(even_board, {1.0: (0.2, 0.3), 0.1: (0.6, 0.6, 0.5)})
    for seed in range(3):
        even_board("frozen", seed, 0.5)
    text = page()
    assert re.search(r"at its best rate \| 0\.60 \[.*?\], 2 seeds at factor 0\.1", text)
    assert re.search(r"at its best rate minus `frozen` \| 0\.07 \[.*?\], 3 seeds \|", text)
    assert "A difference counts every seed that its two sides share" in text
