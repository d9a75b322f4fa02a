"""`clbench.compare`: several methods on one scenario, run where needed, in one table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from clbench.base.errors import InputError
from clbench.jobs.grid import name_of, run_specs
from clbench.records.paths import RECORDS
from clbench.runs.spec import RunSpec
from clbench.spec.fields import is_whole
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.protocol import DEFAULT_SEEDS, FIRST_TUNING_SEED
from clbench.spec.references import BASELINE

from .board.rows import compute_board
from .table import frame_of

if TYPE_CHECKING:
    import pandas

    from clbench.learning.method import Method


def compare(
    scenario: str,
    methods: str | type[Method] | Iterable[str | type[Method]],
    *,
    seeds: int = DEFAULT_SEEDS,
    first_seed: int = 0,
    policy: str = DEFAULT_POLICY,
    records: Path | str = RECORDS,
    workers: int | None = None,
    device: str = "cpu",
) -> pandas.DataFrame:
    """Compare methods on a scenario: do the runs that have no record, and return their rows of the board.

    Plain fine-tuning, "sft", always runs as well, because without it a row says nothing. All methods run with
    the same seeds, and rows count only these seeds, even where the folder has more.

    Args:
        scenario: Gymnasium id of the scenario; "module:id" imports the module first.
        methods: One method or several: classes, installed names, or "module:Class". Classes from a notebook
            run one after the other, see `clbench.run`.
        seeds: Number of seeds.
        first_seed: The first seed. All seeds must be below 100: no board shows the seeds for tuning.
        policy: Name of the policy, such as "discrete_diffusion", "flow-base" or "module:Class".
        records: Folder of the records. Records of other methods are not read.
        workers: Number of runs at once, and of the cores that they share; if None all cores, and with the
            device "cuda" one run per GPU.
        device: Device that runs the policies, for example "cpu" or "cuda".

    Returns:
        One row for each method, by division, the best first. The columns are those of `clbench.load_board`,
        such as each metric with its interval, the costs, and in `letters` which methods are not told apart.

    Raises:
        UnknownNameError: There is no such scenario or method.
        InputError: A value cannot be used, or a record makes no row; the message says why.
        RunsFailedError: A run failed.
    """
    if is_whole(first_seed) and first_seed >= FIRST_TUNING_SEED:
        raise InputError(
            f"first_seed must be below {FIRST_TUNING_SEED}, not {first_seed}: the others are for tuning."
        )
    if is_whole(first_seed) and is_whole(seeds) and first_seed + seeds > FIRST_TUNING_SEED:
        raise InputError(
            f"The last seed must be below {FIRST_TUNING_SEED}, not {first_seed + seeds - 1}: the others are "
            "for tuning. Choose fewer seeds, or a smaller first_seed."
        )
    several = [methods] if isinstance(methods, str | type) else methods
    names = dict.fromkeys([BASELINE, *map(name_of, several)])
    firsts = [RunSpec(scenario, name, first_seed, device=device, policy=policy) for name in names]
    run_specs(firsts, seeds, Path(records), workers)
    places = {
        replace(one, seed=first_seed + number).path(Path()).as_posix()
        for one in firsts
        for number in range(seeds)
    }
    board = compute_board(Path(records), places)
    counted_seeds = {row.method: len(row.seeds) for row in board.rows}
    lacking = {name for name in names if counted_seeds.get(name, 0) < seeds}
    if lacking:
        absent = lacking - counted_seeds.keys()
        what = "No row for" if absent else f"Fewer than {seeds} seeds for"
        reasons = " ".join(map(str, board.not_shown))
        raise InputError(f"{what} {', '.join(sorted(absent or lacking))}. {reasons}")
    return frame_of(board)
