"""Charts in notebooks and files."""

import importlib
from pathlib import Path
from typing import Any

import pytest

from clbench.base.errors import InputError, UnknownNameError

plot: Any = importlib.import_module("clbench.leaderboard").plot


def test_a_notebook_shows_every_method_in_the_colours_of_the_theme(four_methods: Path) -> None:
    light, dark = (plot(four_methods, "clbench/Toy-v0", dark=dark)._repr_svg_() for dark in (False, True))
    for method in ("sft", "replay", "asks", "from_scratch"):
        assert f">{method}</text>" in light
    assert "var(--" not in light + dark
    assert light != dark
    assert plot(four_methods).svg() == light  # the scenario with most rows


def test_a_chart_is_saved_as_the_ending_says(four_methods: Path, tmp_path: Path) -> None:
    chart = plot(four_methods)
    begins = {"svg": b"<svg", "png": b"\x89PNG", "PDF": b"%PDF"}
    for ending, begin in begins.items():
        chart.save(tmp_path / f"chart.{ending}")
        assert (tmp_path / f"chart.{ending}").read_bytes().startswith(begin)
    with pytest.raises(InputError, match=r"chart\.gif must end with one of \.svg, \.png, \.pdf"):
        chart.save(str(tmp_path / "chart.gif"))
    assert not (tmp_path / "chart.gif").exists()


def test_a_wrong_scenario_is_named_and_a_folder_without_rows_too(four_methods: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'clbench/Toy-v0'"):
        plot(four_methods, "clbench/Toy-v1")
    (tmp_path / "bare").mkdir()
    with pytest.raises(InputError, match=r"No record in .*bare makes a row"):
        plot(tmp_path / "bare")
