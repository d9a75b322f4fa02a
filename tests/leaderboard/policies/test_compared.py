"""The comparison of two kinds of policies: seed by seed, and only where both have runs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clbench.base.entry_points import resolve
from clbench.records.record import Record

compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
by_table = resolve("clbench.leaderboard.policies.compared:by_table")
html = resolve("clbench.leaderboard.views.page.html:page")
markdown = resolve("clbench.leaderboard.views.markdown:markdown")
PLACE = "clbench/Toy-v0+discrete_diffusion"


@pytest.fixture
def both(add: Callable[..., Path], matrix: Any, tmp_path: Path) -> Path:
    """Return a folder with `sft` of both policies, two seeds in common, and `lora` of one."""

    def discrete(record: Record) -> None:
        record.run.policy = "discrete_diffusion"

    for seed in range(3):
        add("sft", seed)
        add("lora", seed)
    for seed in range(1, 4):
        better = np.clip(matrix + 0.2 + 0.1 * (seed - 1), 0, 1)
        place = f"Toy-v0+discrete_diffusion/sft/seed-{seed}.json"
        add("sft", seed, better, discrete, place)
    return tmp_path / "leaderboard" / "records"


def test_methods_are_compared_over_the_seeds_that_both_policies_have(both: Path) -> None:
    table = compute_board(both)
    assert not table.not_shown
    comparisons = by_table(table.rows)
    assert list(comparisons) == [PLACE]
    (one,) = comparisons[PLACE]
    assert (one.method, one.seeds) == ("sft", 2)
    runs = {row.scenario: [row.scores[seed] for seed in (1, 2)] for row in table.rows if row.method == "sft"}
    for name, (ours, theirs, difference) in one.estimates.items():
        metric = resolve("clbench.scoring.metrics:measure")
        plain, other = (
            np.mean([metric(name, scores) for scores in runs[place]]) for place in ("clbench/Toy-v0", PLACE)
        )
        assert ours.value == pytest.approx(plain)
        assert theirs.value == pytest.approx(other)
        assert difference.value == pytest.approx(other - plain)
        assert difference.low <= difference.value <= difference.high


def test_the_page_shows_both_policies_and_never_ranks_one_against_the_other(both: Path) -> None:
    table = compute_board(both)
    page = markdown(table, by_table(table.rows))
    heading = PLACE.replace("_", "\\_")
    section = page.partition(f"## {heading}")[2].partition("\n## ")[0]
    assert "Does forgetting depend on the policy?" in section
    assert "| sft | final average |" in section
    assert "lora" not in section
    letters = {(row.scenario, row.method): row.letters for row in table.rows}
    assert letters[PLACE, "sft"] == "a"


def test_a_table_of_one_policy_has_no_comparison(add: Callable[..., Path], tmp_path: Path) -> None:
    add("sft", 0)
    table = compute_board(tmp_path / "leaderboard" / "records")
    assert by_table(table.rows) == {}
    assert "Does forgetting depend" not in markdown(table, by_table(table.rows))


def test_the_section_of_another_policy_says_what_it_is(both: Path) -> None:
    board = compute_board(both)
    text = " ".join(html(board, by_table(board.rows)).split())
    assert "The final average is its success on the skills and all new tasks at the end." in text
    assert "The policy is discrete diffusion: masked action tokens are filled in, the surest first" in text
