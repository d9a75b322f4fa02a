"""The CSV file: the data frame, with missing values empty."""

from collections.abc import Callable
from pathlib import Path

import pandas

from clbench.base.entry_points import resolve

load = resolve("clbench:load_board")


def test_the_csv_file_is_the_data_frame(four_methods: Path, shown: Callable[[], tuple[str, str]]) -> None:
    shown()
    written = pandas.read_csv(four_methods.parent / "site" / "leaderboard.csv")
    pandas.testing.assert_frame_equal(written, load(four_methods), check_dtype=False, atol=6e-5, rtol=0)


def test_a_cost_is_the_mean_over_the_seeds(
    four_methods: Path, add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    for seed in range(2):
        add_full(
            "counted",
            seed,
            edit=lambda record, seed=seed: setattr(record.costs, "optimiser_steps", 100 + seed),
        )
    shown()
    written = pandas.read_csv(four_methods.parent / "site" / "leaderboard.csv")
    counted = written[written["method"] == "counted"]
    assert counted[["seeds", "steps"]].to_numpy().tolist() == [[2, 100.5]]
