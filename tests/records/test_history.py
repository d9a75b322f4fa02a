"""Records of older schemas stay readable: `historic` holds real ones of each, as runs left them."""

import json
from pathlib import Path
from typing import Any

import pytest

from clbench.base.errors import InputError
from clbench.records.history import OLDEST
from clbench.records.reader import RecordError, read_record
from clbench.records.record import SCHEMA, Costs
from clbench.records.writer import write_record
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores

HISTORIC = Path(__file__).parent / "historic"

VALUES: dict[str, dict[str, float | None]] = {
    "schema-2/DMControl-v0-sac-online.json": {
        "final_average": 0.15,
        "retention": 0.22,
        "question_retention": None,
    },
    "schema-2/Fetch-v0-weight_interpolation-tuning.json": {
        "final_average": 0.5285714285714286,
        "question_retention": 0.989,
        "activation_drift": 7.534790515899658,
    },
    "schema-3/Fetch-v1-sft-tuning.json": {
        "final_average": 0.24375,
        "retention": 0.2625,
        "shift": 1.3276978582143784,
        "instruction_capture": None,
    },
    "schema-4/Fetch-v1-sft-seed-0.json": {
        "final_average": 0.4857142857142857,
        "adaptation": 0.9,
        "kept": 0.4,
        "shift": 0.7951867654919624,
    },
    "schema-2/MetaWorld-v0-sft-order-1.json": {
        "final_average": 0.5333333333333333,
        "retention": 0.41875,
        "zero_shot": 0.65,
    },
}
"""Values of metrics of every historic record, by its path."""


def test_every_older_schema_has_a_historic_record() -> None:
    assert {path.name for path in HISTORIC.iterdir()} == {
        f"schema-{number}" for number in range(OLDEST, SCHEMA)
    }
    assert {path.relative_to(HISTORIC).as_posix() for path in HISTORIC.rglob("*.json")} == set(VALUES)


@pytest.mark.parametrize("name", VALUES)
def test_a_historic_record_has_its_metrics(name: str) -> None:
    scores = Scores.from_record(read_record(HISTORIC / name), partial=True)  # older protocols asked for less
    found = {metric: measure(metric, scores) for metric in VALUES[name]}
    assert found == pytest.approx(VALUES[name])


@pytest.mark.parametrize("name", VALUES)
def test_a_historic_record_can_be_written_in_the_present_schema_if_it_has_a_definition(
    name: str, tmp_path: Path
) -> None:
    record = read_record(HISTORIC / name)
    if "definition" not in record.fingerprint:
        with pytest.raises(InputError, match=r"fingerprint\.definition must be an object"):
            write_record(record, tmp_path / "record.json")
        return
    write_record(record, tmp_path / "record.json")
    assert json.loads((tmp_path / "record.json").read_text(encoding="utf-8"))["schema"] == SCHEMA
    assert read_record(tmp_path / "record.json") == record


def test_the_only_policy_of_schema_4_is_named() -> None:
    assert read_record(HISTORIC / "schema-4" / "Fetch-v1-sft-seed-0.json").run.policy == "flow"


def test_words_of_schema_2_are_translated() -> None:
    tuning = read_record(HISTORIC / "schema-2" / "Fetch-v0-weight_interpolation-tuning.json")
    assert (tuning.run.split, set(tuning.episodes["split"])) == ("validation", {"validation"})
    budget = tuning.scenario.budget
    assert (budget["validation_episodes"], budget["test_episodes"]) == (10, 20)
    assert budget["test_questions"] == 1000
    assert budget["noisy_demonstrations"] == 0.5
    assert not {"selection_episodes", "report_episodes", "report_questions", "perturbation"} & set(budget)


def test_fields_that_schema_2_lacks_have_their_usual_values() -> None:
    online = read_record(HISTORIC / "schema-2" / "DMControl-v0-sac-online.json")
    assert (online.run.order, online.run.perturb) == (0, False)
    assert online.costs == Costs(parameters=428296, environment_steps=30000)
    sft = read_record(HISTORIC / "schema-2" / "MetaWorld-v0-sft-order-1.json")
    assert (sft.run.order, sft.run.settings) == (1, {"step_factor": 1.0})
    assert "step_factor" not in online.run.settings  # another program chose its learning rate


def test_quantities_that_schema_2_did_not_measure_are_missing() -> None:
    tuning = read_record(HISTORIC / "schema-2" / "Fetch-v0-weight_interpolation-tuning.json")
    assert tuning.policy["shift"] == [None] * len(tuning.policy["stage"]) != []
    assert tuning.relearning is None


OLD = {
    2: HISTORIC / "schema-2" / "DMControl-v0-sac-online.json",
    3: HISTORIC / "schema-3" / "Fetch-v1-sft-tuning.json",
    4: HISTORIC / "schema-4" / "Fetch-v1-sft-seed-0.json",
}


def put(values: dict[str, Any], place: str, value: Any) -> None:
    *parents, last = place.split(".")
    for parent in parents:
        values = values[parent]
    values[last] = value


@pytest.mark.parametrize(
    ("schema", "place", "value", "words"),
    [
        (2, "run.order", 0, "run: order must be above 0 in schema 2"),
        (2, "run.order", "1", "run: order must be a whole number"),
        (2, "run.perturb", False, "run: perturb must be true in schema 2"),
        (2, "run.split", "test", "run: split: schema 2 has no test"),
        (2, "run.oder", 1, "No field of run is called 'oder'. Did you mean 'order'?"),
        (2, "scenario.budget.test_episodes", 20, "budget: schema 2 has no test_episodes"),
        (2, "episodes.split", ["validation"], "episodes: split: schema 2 has no validation"),
        (2, "episodes.stage", [0], "the columns of episodes have different lengths"),
        (2, "costs.parametres", 1, "No field of costs is called 'parametres'"),
        (2, "relearning", None, "a record: schema 2 has no relearning"),
        (2, "policy.shift", [], "policy: schema 2 has no shift"),
        (3, "policy.captured", [], "policy: schema 3 has no captured"),
        (4, "run.policy", "flow", "run: schema 4 has no policy"),
        (4, "fingerprint.definition", None, r"schema 4: fingerprint\.definition must be an object"),
        (3, "content", None, "its content does not match its hash"),
        (2, "content", "0123", "a record of schema 2 has no content"),
        (2, "scenario", [], "scenario must be an object"),
        (2, "episodes", None, "episodes must be an object"),
        (2, "run", 5, "run must be an object"),
        (2, "scenario.budget", None, "scenario: budget must be an object"),
    ],
)
def test_a_record_that_breaks_its_old_schema_is_refused_with_the_fault(
    schema: int, place: str, value: Any, words: str, tmp_path: Path
) -> None:
    values = json.loads(OLD[schema].read_text(encoding="utf-8"))
    put(values, place, value)
    (tmp_path / "record.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(RecordError, match=words):
        read_record(tmp_path / "record.json")


def test_perturbed_runs_of_schema_2_are_read(tmp_path: Path) -> None:
    values = json.loads(OLD[2].read_text(encoding="utf-8"))
    values["run"]["perturb"] = True
    values["episodes"]["split"][0] = "perturbed"
    (tmp_path / "record.json").write_text(json.dumps(values), encoding="utf-8")
    record = read_record(tmp_path / "record.json")
    assert record.run.perturb
    assert record.episodes["split"][:2] == ["perturbed", "test"]
