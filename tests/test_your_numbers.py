"""The worked example of `docs/guide/your_numbers.md`, run unchanged, and the figures that the page states."""

import re
import subprocess
import sys
from pathlib import Path

import numpy
import pytest

from clbench.metrics import from_csv

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "your_numbers.md"


def _block(language: str) -> str:
    (block,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    return str(block)


def _run(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.long
def test_its_command_prints_what_the_page_shows(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text(_block("csv"), encoding="utf-8")
    printed = _run(tmp_path, "-m", *_block("console").split()).splitlines()
    rest = iter([line.rstrip() for line in printed])
    shown = [line for line in _block("text").splitlines() if line != "..."]
    assert [line for line in shown if line not in rest] == []  # each after the one before


def test_its_script_prints_a_value_a_reason_and_the_flips(tmp_path: Path) -> None:
    value, reason, *flips = _run(tmp_path, "-c", _block("python")).splitlines()
    assert float(value) == pytest.approx(0.45)
    assert reason == "No method is called joint."
    assert any(line.startswith("average sft") for line in flips)


def test_its_forward_transfer_of_gem_is_the_mean_gain_over_stage_0_just_before_learning() -> None:
    (formula,) = re.findall(r"`(numpy\.mean\(.*?)`", PAGE.read_text(encoding="utf-8"))
    matrix = numpy.random.default_rng(0).random((5, 4))
    gains = [matrix[k - 1][k - 1] - matrix[0][k - 1] for k in range(2, 5)]  # target k is column k - 1
    assert eval(formula, {"numpy": numpy, "R": matrix}) == pytest.approx(sum(gains) / 3)


def test_it_states_what_robocasa365_gives() -> None:
    text, report = PAGE.read_text(encoding="utf-8"), from_csv("robocasa365.csv")
    stated = re.findall(r"(0\.\d{3})\s+\(`(\w+)`\)", text)
    assert len(stated) == 4
    for number, name in stated:
        assert f"{report[name].value:.3f}" == number
