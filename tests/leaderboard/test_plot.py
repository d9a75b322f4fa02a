"""Charts in notebooks and files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import RATES

import clbench
from clbench import plot
from clbench.base.errors import InputError, UnknownNameError
from clbench.records.paths import record_path
from clbench.records.reader import RecordError
from clbench.records.record import Record
from clbench.records.writer import write_record


@pytest.fixture
def record(make_record: Callable[..., Record]) -> Callable[..., Record]:
    """Return a function that makes a record of two targets."""
    return lambda **options: make_record(RATES, episodes=4, **options)


def test_the_charts_are_at_the_front_door() -> None:
    assert plot.__all__ == ["curves", "frontier", "matrix", "plane"]
    assert dir(clbench.plot) == plot.__all__


def test_a_matrix_shows_each_stage_on_each_task_and_frames_what_was_learned(
    record: Callable[..., Record],
) -> None:
    chart = plot.matrix(record())
    cells = chart.spec["data"]["values"]
    shown = np.reshape([cell["success"] for cell in cells], np.shape(RATES))
    np.testing.assert_allclose(shown, RATES)
    learned = [(cell["after"], cell["task"]) for cell in cells if cell["learned"]]
    assert learned == [(f"after target_{number}", f"target_{number}") for number in range(2)]
    svg = chart._repr_svg_()
    for text in ("sft on clbench/Toy-v0, seed 0", "pretrained", "after target_0", "held out", "0.75"):
        assert f">{text}</text>" in svg
    assert "var(--" not in svg


def test_a_matrix_of_several_runs_is_their_mean(record: Callable[..., Record]) -> None:
    lucky = record(seed=1)
    lucky.episodes["success"] = [1] * len(lucky.episodes["success"])
    cells = plot.matrix([record(), lucky]).spec["data"]["values"]
    shown = np.reshape([cell["success"] for cell in cells], np.shape(RATES))
    np.testing.assert_allclose(shown, (np.array(RATES) + 1) / 2, atol=5e-4)  # of three digits


def test_runs_in_other_orders_of_the_targets_have_them_numbered(record: Callable[..., Record]) -> None:
    first, other = record(), record(seed=1)
    other.scenario.target.reverse()
    swapped = dict(zip(first.scenario.target, other.scenario.target, strict=True))
    other.episodes["task"] = [swapped.get(task, task) for task in other.episodes["task"]]
    for chart in (plot.matrix([first, other]), plot.curves([first, other])):
        assert "sft on clbench/Toy-v0, mean of 2 runs" in chart.svg()
        assert ">target 2</text>" in chart.svg()
        assert ">target_1</text>" not in chart.svg()


def test_curves_have_the_points_and_intervals_of_the_page(
    record: Callable[..., Record], tmp_path: Path
) -> None:
    for seed in range(2):
        one = record(seed=seed, curves=[[0.25, 0.5, 0.75], [0, 0.5, 1]])
        write_record(one, record_path(tmp_path, one.run.scenario, one.run.method, seed))
    points = plot.curves(str(tmp_path)).spec["datasets"]["points"]
    target = [point for point in points if point["series"] == "target of the stage"]
    assert [(point["x"], point["y"]) for point in target] == [
        *zip((0, 100, 200, 300, 400), (0, 0.25, 0.5, 0.75, 1), strict=True),
        *zip((400, 500, 600, 700, 800), (0, 0, 0.5, 1, 1), strict=True),
    ]
    assert [point["stage"][-1] for point in target] == [*"00000", *"11111"]
    assert all(point["low"] <= point["y"] <= point["high"] for point in points)


def test_curves_are_compared_with_those_of_plain_fine_tuning(record: Callable[..., Record]) -> None:
    method, sft = record(method="ours"), record()
    assert ">old skills under sft</text>" not in plot.curves(method).svg()
    assert ">old skills under sft</text>" in plot.curves(method, sft).svg()


def test_curves_of_another_method_do_not_pass_for_plain_fine_tuning(record: Callable[..., Record]) -> None:
    with pytest.raises(InputError, match="must be of sft, not of lora"):
        plot.curves(record(), sft=record(method="lora"))
    assert "seed 0; sft: 2 runs" in plot.curves(record(), sft=[record(), record(seed=1)]).svg()


def test_runs_that_do_not_belong_together_are_refused(
    record: Callable[..., Record], make_record: Callable[..., Record], tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"one method on one scenario, not sft on .*, lora on "):
        plot.matrix([record(), record(method="lora")])
    with pytest.raises(InputError, match="There is no record to draw"):
        plot.matrix(tmp_path)
    with pytest.raises(InputError, match="do not mix"):
        plot.curves(record(), make_record(RATES, episodes=8))
    with pytest.raises(RecordError, match=r"gone\.json: cannot be read"):
        plot.curves(tmp_path / "gone.json")


def test_a_plane_is_that_of_the_scenario_with_most_rows(
    record: Callable[..., Record], tmp_path: Path
) -> None:
    rows = {"clbench/A-v0": ["sft"], "clbench/B-v0": ["sft", "lora"], "clbench/C-v0": ["lora"]}
    for scenario, methods in rows.items():
        for method in methods:
            path = record_path(tmp_path, scenario, method, 0)
            write_record(record(scenario=scenario, method=method), path)
    points = plot.plane(tmp_path).spec["datasets"]["points"]
    assert sorted(point["method"] for point in points) == ["lora", "sft"]


@pytest.mark.long
def test_a_plane_shows_every_method_in_the_colours_of_the_theme(four_methods: Path) -> None:
    light, dark = (
        plot.plane(four_methods, "clbench/Toy-v0", dark=dark)._repr_svg_() for dark in (False, True)
    )
    for text in ("clbench/Toy-v0", "sft", "replay", "asks", "from_scratch"):
        assert f">{text}</text>" in light
    assert "Thin lines: 95 % intervals, cut off at the edge." in light
    assert "var(--" not in light + dark
    assert light != dark
    assert plot.plane(str(four_methods)).svg() == light  # the scenario with most rows


def test_a_plane_without_kept_skills_is_refused(make_record: Callable[..., Record], tmp_path: Path) -> None:
    record = make_record([[0.0, 0.0, 0.25], [1.0, 0.0, 0.0], [0.75, 1.0, 0.0]], episodes=4, groups=(0, 2, 1))
    write_record(record, record_path(tmp_path, "clbench/Toy-v0", "sft", 0))
    with pytest.raises(InputError, match="No row of clbench/Toy-v0 has both kept skills and learned targets"):
        plot.plane(tmp_path)


def test_a_frontier_shows_the_methods_of_the_ladder(record: Callable[..., Record], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no ladder at .*ladder\. `make ladder` runs it"):
        plot.frontier(tmp_path / "records")
    (tmp_path / "ladder").mkdir()
    with pytest.raises(InputError, match=r"No record in .*ladder makes a curve"):
        plot.frontier(tmp_path / "records")
    for factor in (1.0, 0.3):
        changes = {"step_factor": factor}
        one = record(changes=changes, settings=changes)
        name = f"sft+step_factor={factor}"
        write_record(one, record_path(tmp_path / "ladder", one.run.scenario, name, 0))
    assert ">sft</text>" in plot.frontier(str(tmp_path / "records")).svg()
    with pytest.raises(UnknownNameError, match="Did you mean 'clbench/Toy-v0'"):
        plot.frontier(tmp_path / "records", "clbench/Toy-v1")


def test_a_frontier_leaves_out_runs_that_cannot_be_compared_with_the_board(
    record: Callable[..., Record], tmp_path: Path
) -> None:
    for scenario, rollouts in (("clbench/Toy-v0", "1234"), ("clbench/Other-v0", "4567")):
        of_board = record(scenario=scenario)
        of_board.fingerprint["rollouts"] = {"toy:world": rollouts}
        write_record(of_board, record_path(tmp_path / "records", scenario, "sft", 0))
        for factor in (1.0, 0.3):
            changes = {"step_factor": factor}
            one = record(scenario=scenario, changes=changes, settings=changes)
            one.fingerprint["rollouts"] = {"toy:world": "1234"}
            name = f"sft+step_factor={factor}"
            write_record(one, record_path(tmp_path / "ladder", scenario, name, 0))
    assert ">sft</text>" in plot.frontier(tmp_path / "records").svg()
    with pytest.raises(UnknownNameError, match="No scenario with a curve is called 'clbench/Other-v0'"):
        plot.frontier(tmp_path / "records", "clbench/Other-v0")


def test_a_chart_is_saved_as_the_ending_says(record: Callable[..., Record], tmp_path: Path) -> None:
    chart = plot.matrix(record())
    begins = {"svg": b"<svg", "png": b"\x89PNG", "PDF": b"%PDF"}
    for ending, begin in begins.items():
        chart.save(tmp_path / f"chart.{ending}")
        assert (tmp_path / f"chart.{ending}").read_bytes().startswith(begin)
    with pytest.raises(InputError, match=r"chart\.gif must end with one of \.svg, \.png, \.pdf"):
        chart.save(str(tmp_path / "chart.gif"))
    assert not (tmp_path / "chart.gif").exists()


def test_a_wrong_scenario_is_named_and_a_folder_without_rows_too(four_methods: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'clbench/Toy-v0'"):
        plot.plane(four_methods, "clbench/Toy-v1")
    (tmp_path / "bare").mkdir()
    with pytest.raises(InputError, match=r"No record in .*bare makes a row"):
        plot.plane(tmp_path / "bare")
