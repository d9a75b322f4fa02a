"""An agent's evaluation, and a run whose stages end at a criterion."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from eager import EAGER

from clbench.records.record import Record
from clbench.runs.agents import evaluate_agent
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec


@pytest.fixture
def evaluate(tmp_path: Path, empty_caches: Path) -> Callable[..., Any]:
    """Return `evaluate_agent` for the method me/knows, with separate records and caches for the test."""

    def evaluate(agent: Any, env: Any, **options: Any) -> Any:
        return evaluate_agent(
            agent, env, **{"method": "me/knows", "records": tmp_path / "records", **options}
        )

    return evaluate


@pytest.fixture(scope="package")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """A run of plain fine-tuning."""
    return execute(RunSpec(EAGER.id, "sft", seed=0), tmp_path_factory.mktemp("records"))
