"""Many records as one table of pandas, for analyses of one's own."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from clbench.records.paths import RECORDS, check_folder
from clbench.records.reader import RecordError, read_record
from clbench.records.tables import TYPES, frame, typed

if TYPE_CHECKING:
    import pandas

LOG = logging.getLogger("clbench")


def load_records(folder: Path | str = RECORDS) -> pandas.DataFrame:
    """Return all evaluation episodes of the records below a folder, one row for each episode.

    Columns: `scenario` (Gymnasium id), `method` (with changed settings, as "lora+rank=4"), `seed`, `order`,
    `stage` (0 is before the first target), `step` (optimiser steps done in the stage), `task`, `group`
    ("retained", "target" or "held_out"), `split` ("test", "validation" or "perturbed"), `episode`, `success`
    (a boolean) and `length` (steps). Records of failed runs, and files that are no records, are left out; the
    log names them.

    Args:
        folder: Folder of records, at any depth.

    Raises:
        NoRecordsError: There is no such folder.
    """
    import pandas

    check_folder(Path(folder))
    frames = []
    for path in sorted(Path(folder).rglob("*.json")):
        try:
            record = read_record(path)
        except RecordError as error:
            LOG.warning("%s", error)
            continue
        if record.status == "success":
            frames.append(frame(record))
        else:
            LOG.warning("%s: the run failed.", path)
    if not frames:
        return typed(pandas.DataFrame(columns=list(TYPES)))
    return pandas.concat(frames, ignore_index=True)
