"""Commands on pages: they name the runs of a row again, in ranges of seeds."""

import shlex
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from clbench.base.entry_points import resolve

commands_of = resolve("clbench.leaderboard.board.commands:commands_of")
run_command = resolve("clbench.leaderboard.board.commands:run_command")


def _run(seed: int, *, device: str = "cpu", perturb: bool = False, table: str = "clbench/Toy-v0") -> Any:
    """Return a run, as far as commands read it."""
    info = SimpleNamespace(device=device, perturb=perturb)
    return SimpleNamespace(table=table, label="lora", seed=seed, record=SimpleNamespace(run=info))


def _seeds(command: str) -> set[int]:
    """Return the seeds of a command."""
    words = shlex.split(command)
    first = int(words[words.index("--first-seed") + 1]) if "--first-seed" in words else 0
    return set(range(first, first + int(words[words.index("--seeds") + 1])))


def test_seeds_in_a_row_share_a_command_and_others_do_not() -> None:
    for seeds in ([0], [1], [0, 1, 2], [1, 2], [0, 2], [0, 1, 5, 6, 9]):
        commands = commands_of(_run(seed) for seed in seeds)
        assert [seed for command in commands for seed in sorted(_seeds(command))] == seeds
        breaks = sum(second - first > 1 for first, second in pairwise(seeds))
        assert len(commands) == 1 + breaks
    assert commands_of(map(_run, [0, 1])) == ["clbench run clbench/Toy-v0 lora --seeds 2"]


def test_runs_that_were_made_in_another_way_have_a_command_of_their_own() -> None:
    runs = [_run(0), _run(1, perturb=True), _run(2, perturb=True), _run(3, device="cuda")]
    assert commands_of(runs) == [
        "clbench run clbench/Toy-v0 lora --seeds 1",
        "clbench run clbench/Toy-v0 lora --seeds 2 --first-seed 1 --perturb",
        "clbench run clbench/Toy-v0 lora --seeds 1 --first-seed 3 --device cuda",
    ]


def test_a_table_of_another_policy_names_it() -> None:
    (command,) = commands_of([_run(0, table="clbench/Toy-v0+discrete_diffusion")])
    assert command == "clbench run clbench/Toy-v0 lora --seeds 1 --policy discrete_diffusion"


@pytest.mark.parametrize(
    ("records", "ladder"), [("mine/records", "mine/ladder"), (".", "../ladder"), ("..", "../../ladder")]
)
def test_the_ladder_is_beside_the_folder_of_records(records: str, ladder: str) -> None:
    command = run_command("clbench/Toy-v0", "sft@0.3", records=Path(records))
    assert command.endswith(f"--records {ladder}")
    changed = run_command("clbench/Toy-v0", "lora+rank=4", records=Path(records), controls=Path("others"))
    assert changed.endswith("--set.rank 4 --records others")


def test_changed_settings_and_rungs_of_the_ladder_go_to_their_own_folders() -> None:
    assert run_command("clbench/Toy-v0", "sft", "lora") == "clbench run clbench/Toy-v0 sft lora"
    assert run_command("clbench/Toy-v0", "lora+rank=4") == (
        "clbench run clbench/Toy-v0 lora --set.rank 4 --records leaderboard/controls"
    )
    assert run_command("clbench/Toy-v0", "sft@0.3") == (
        "clbench run clbench/Toy-v0 sft --set.step_factor 0.3 --records leaderboard/ladder"
    )
    assert run_command("clbench/Toy-v0", "sft", records=Path("my records")).endswith("--records 'my records'")
