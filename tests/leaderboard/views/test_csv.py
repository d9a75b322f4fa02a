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
