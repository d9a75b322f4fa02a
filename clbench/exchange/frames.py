"""Many records as one table of pandas, for your own analyses."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING

from clbench.base.text import printable
from clbench.records.paths import RECORDS, check_folder
from clbench.records.reader import RecordError, check_home, read_record
from clbench.records.record import Record
from clbench.records.tables import TYPES, frame, typed
from clbench.scoring.scores import Scores

if TYPE_CHECKING:
    import pandas

LOG = logging.getLogger("clbench")


def load_records(folder: Path | str = RECORDS) -> pandas.DataFrame:
    """Return all evaluation episodes of the records below a folder, one row for each episode.

    Columns: `scenario` (Gymnasium id), `policy` ("flow", "discrete_diffusion" and so on), `method` (with
    changed settings, as "lora+rank=4"), `seed`, `order`, `stage` (0 is before the first target), `step`
    (optimiser steps done in the stage), `task`, `group` ("retained", "target" or "held_out"), `split`
    ("test", "validation" or "perturbed"), `episode`, `success` (a boolean) and `length` (steps). Records of
    failed runs and second records of a run are left out. So are files that are not records, that contradict
    themselves, or that are not at the place of their run (SCENARIO/METHOD/seed-N.json). The log names them.

    Args:
        folder: Folder of records, at any depth.

    Raises:
        NoRecordsError: There is no such folder.
    """
    import pandas

    check_folder(Path(folder))
    found: dict[tuple[str, Path], Path] = {}
    frames = []
    for path in sorted(Path(folder).rglob("*.json")):
        try:
            record, place = _read(path)
        except RecordError as error:
            LOG.warning("%s", printable(str(error)))
            continue
        first = found.setdefault((record.run.split, place), path)
        if first == path:
            frames.append(frame(record))
        else:
            LOG.warning("%s", printable(f"{path}: its run has another record, {first}."))
    return (
        pandas.concat(frames, ignore_index=True) if frames else typed(pandas.DataFrame(columns=list(TYPES)))
    )


def _read(path: Path) -> tuple[Record, Path]:
    """Return the record of a run that succeeded, and its path from the folder of records.

    Raises:
        RecordError: The record cannot be read, contradicts itself or is not at the place of its run, or the
            run failed.
    """
    record = read_record(path)
    try:
        if record.status != "success":
            raise RecordError("the run failed.")
        home = check_home(record.run, Path(os.path.realpath(path)))
        Scores.from_record(record, partial=True)
        return record, home
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from error
