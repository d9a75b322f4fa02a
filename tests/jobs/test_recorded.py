"""Records that need no job: older ones count, and damaged ones are set aside."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tiny import TINY

from clbench.base.errors import InputError
from clbench.jobs.recorded import changed_code, is_of, set_aside
from clbench.learning.registry import describe_method
from clbench.policy.transformer import TransformerPolicy
from clbench.runs.fingerprint import describe_policy
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec


class Weighed(TransformerPolicy):
    """Has pretrained weights of its own."""

    pretrained = True


def test_a_record_counts_although_it_is_older_than_the_hash_of_the_weights() -> None:
    policy = f"{__name__}:Weighed"
    run = RunSpec(TINY.id, "sft", 0, policy=policy).resolve()
    now = describe_policy(run.scenario, 0)
    record: Any = SimpleNamespace(
        fingerprint={"method": describe_method(run.method), "policy": now["policy"]}
    )
    assert changed_code(record, run) == []
    record.fingerprint["weights"] = "others"
    assert changed_code(record, run) == [f"the weights of {policy} have changed"]


@pytest.mark.long
def test_a_record_counts_although_it_is_older_than_definitions(tmp_path: Path) -> None:
    spec = RunSpec(TINY.id, "frozen", 0, targets=1)
    record, run = execute(spec, tmp_path), spec.resolve()
    assert record.fingerprint.pop("definition")
    assert is_of(record, run, spec.path(tmp_path))
    record.fingerprint["definition"] = {"questions": "others"}
    with pytest.raises(InputError, match="was made with another definition of me/Tiny-v0"):
        is_of(record, run, spec.path(tmp_path))


@pytest.mark.parametrize("goes", [False, True], ids=["stays", "another command is faster"])
@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_damaged_record_is_set_aside_unless_another_command_has_done_so(
    kind: str, goes: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunSpec(TINY.id, "sft", 0).resolve()
    path = run.path(tmp_path)
    path.parent.mkdir(parents=True)
    if kind == "file":
        path.write_text("{", encoding="utf-8")
    else:
        path.symlink_to("nowhere")
    replace = Path.replace

    def late(here: Path, there: Path) -> Path:
        here.unlink()
        return replace(here, there)

    if goes:
        monkeypatch.setattr(Path, "replace", late)
    said = set_aside(run, tmp_path)
    assert said is not None
    assert said.endswith("The record is renamed to seed-0.json.damaged, and the run is repeated.")
    left = [] if goes else ["seed-0.json.damaged"]
    assert [one.name for one in path.parent.iterdir()] == left
