"""`clbench new-method` and `new-policy`: files that work as they are, and names that are refused."""

import errno
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tiny import TINY
from verification import failures, verify

from clbench import load_scenario
from clbench.base.errors import InputError
from clbench.cli.main import app
from clbench.cli.scaffold import class_name, write_method, write_policy
from clbench.jobs.recorded import has_record, set_aside
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.registry import load_method
from clbench.records.reader import read_record
from clbench.records.writer import write_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores
from clbench.testing import check_method, check_policy


def _python(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=600, check=False)


@pytest.fixture
def clbench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function that does a command in the folder of the test."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # and take back what the command puts there
    return lambda *words: app(words, result_action="return_value")


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Write a new method and return the name of its module, which can be imported."""
    name = "freshly_written"
    write_method(name, tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


@pytest.mark.long
def test_a_fresh_template_keeps_the_contract(fresh: str) -> None:
    cls = load_method(f"{fresh}:FreshlyWritten")
    check_method(cls)
    assert cls.metadata.licence == "MIT"


@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("command", [("check", "--select=A,B,E,F,I,N,RUF,UP,W"), ("format", "--check")])
def test_a_fresh_template_is_linted_and_formatted_by_ruffs_own_settings(
    command: tuple[str, ...], tmp_path: Path
) -> None:
    result = _python("ruff", command[0], "--isolated", "freshly_written.py", *command[1:], folder=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.fixture
def fresh_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Write a new policy and return its kind."""
    write_policy("fresh_policy", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield "fresh_policy:FreshPolicy"
    sys.modules.pop("fresh_policy", None)


@pytest.mark.long
def test_a_fresh_policy_keeps_the_contract(fresh_policy: str) -> None:
    check_policy(fresh_policy)


@pytest.mark.usefixtures("fresh_policy")
@pytest.mark.parametrize("command", [("check", "--select=A,B,E,F,I,N,RUF,UP,W"), ("format", "--check")])
def test_a_fresh_policy_is_linted_and_formatted_by_ruffs_own_settings(
    command: tuple[str, ...], tmp_path: Path
) -> None:
    result = _python("ruff", command[0], "--isolated", "fresh_policy.py", *command[1:], folder=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    "method",
    [
        "sft",
        "lora",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("consft", "experience_replay")),
    ],
)
def test_methods_fine_tune_a_fresh_policy(method: str, fresh_policy: str, tmp_path: Path) -> None:
    spec = RunSpec("clbench.testing:clbench/Toy-v0", method, 0, policy=fresh_policy)
    record = execute(spec, tmp_path / "records")
    assert (record.status, record.run.policy) == ("success", fresh_policy)
    path = tmp_path / "records" / "Toy-v0+fresh_policy.FreshPolicy" / method / "seed-0.json"
    scores = Scores.from_record(read_record(path))
    # it cannot answer, and shows no hidden states
    assert measure("question_retention", scores) is None
    assert measure("activation_drift", scores) is None
    learned = measure("adaptation", scores)
    assert learned is not None
    assert learned > 0.5


@pytest.mark.long
def test_a_record_of_a_fresh_policy_is_replayed_only_if_the_verifier_names_it(
    fresh_policy: str, tmp_path: Path
) -> None:
    spec = RunSpec("clbench.testing:clbench/Toy-v0", "sft", 0, policy=fresh_policy)
    execute(spec, tmp_path / "records", checkpoints=tmp_path / "checkpoints")
    path = spec.path(tmp_path / "records")
    assert failures(verify(path, "recomputed")) == ""
    words = failures(verify(path, "replayed", tmp_path))
    assert f"{fresh_policy} is not installed: name it with --policy to import and run its code" in words
    assert failures(verify(path, "replayed", tmp_path, policy=fresh_policy)) == ""


OWN = """
from pathlib import Path
from typing import Any

import torch
from fresh_policy import FreshPolicy


class Own(FreshPolicy):
    pretrained = True

    def __init__(self, config, seed=0):
        super().__init__(config, seed)
        value = float(Path(__file__).with_name("weights.txt").read_text())
        for parameter in self.parameters():
            torch.nn.init.constant_(parameter, value)
"""


def own_weights(folder: Path, value: str) -> None:
    """Write weights that `OWN` reads, and forget the module, as another process would."""
    sys.modules.pop("own_policy", None)
    (folder / "own_policy.py").write_text(OWN, encoding="utf-8")
    (folder / "weights.txt").write_text(value, encoding="utf-8")


@pytest.mark.usefixtures("fresh_policy")
def test_runs_start_from_the_weights_that_a_policys_own_file_has_now(tmp_path: Path) -> None:
    own_weights(tmp_path, "0.5")
    scenario = load_scenario("clbench.testing:clbench/Toy-v0").with_policy("own_policy:Own")
    found = []
    for value in ("0.5", "0.25", "0.5"):
        own_weights(tmp_path, value)
        policy, folder = pretrained_policy(scenario, seed=0)
        assert {one for weight in policy.parameters() for one in weight.flatten().tolist()} == {float(value)}
        found.append(folder)
    assert found[0] == found[2] != found[1]
    # equal weights are kept once, whatever the seed
    assert pretrained_policy(scenario, seed=1)[1] == found[2]


def test_a_method_whose_need_a_fresh_policy_lacks_is_refused_by_name(fresh_policy: str) -> None:
    for method, lacks in (
        ("aegis", "hidden_states"),
        ("stop_gradient", "hidden_states"),
        ("joint", "answers"),
    ):
        with pytest.raises(InputError, match=f"{method} needs .*; fresh_policy:FreshPolicy lacks {lacks}"):
            RunSpec("clbench.testing:clbench/Toy-v0", method, 0, policy=fresh_policy).resolve()


def test_new_policy_prints_the_next_steps(
    clbench: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    clbench("new-policy", "diffusion")
    assert capsys.readouterr().out.splitlines() == [
        "Wrote diffusion.py and test_diffusion.py. Edit the policy, then run:",
        "  python -m pytest test_diffusion.py  # pip install pytest",
        "  clbench run clbench/Fetch-v1 sft --policy diffusion:Diffusion",
    ]


def test_a_policy_cannot_be_named_like_a_built_in_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'flow' is a built-in policy\. Did you mean 'my_flow'"):
        write_policy("flow", tmp_path)


def test_the_command_prints_the_next_steps(
    clbench: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    clbench("new-method", "freshly_written")
    assert capsys.readouterr().out.splitlines() == [
        "Wrote freshly_written.py and test_freshly_written.py. Edit the method, then run:",
        "  python -m pytest test_freshly_written.py  # pip install pytest",
        "  clbench submit freshly_written:FreshlyWritten",
    ]


@pytest.mark.long
def test_pytest_finds_the_fresh_tests(tmp_path: Path) -> None:
    write_method("freshly_written", tmp_path)
    write_policy("diffusion", tmp_path)
    found = _python("pytest", "--collect-only", "-q", folder=tmp_path).stdout
    assert "test_diffusion_keeps_the_contract" in found
    assert "test_freshly_written_keeps_the_contract" in found


@pytest.mark.long
def test_a_fresh_template_runs(fresh: str, tmp_path: Path) -> None:
    spec = RunSpec("clbench.testing:clbench/Toy-v0", f"{fresh}:FreshlyWritten", 0)
    record = execute(spec, tmp_path / "records")
    assert (record.status, record.run.settings) == ("success", {"step_factor": 1.0, "share": 0.9})


def test_the_next_steps_name_another_folder(
    tmp_path: Path, clbench: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my methods").mkdir()
    clbench("new-method", "freshly_written", "--folder", "my methods")
    assert capsys.readouterr().out.splitlines()[1] == "  cd 'my methods'"
    assert sorted(path.name for path in (tmp_path / "my methods").iterdir()) == [
        "freshly_written.py",
        "test_freshly_written.py",
    ]


def test_a_full_disk_names_the_file_and_leaves_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = Path.open

    def full(path: Path, *arguments: Any, **options: Any) -> Any:
        file = usual(path, *arguments, **options)
        if "x" in arguments:
            monkeypatch.setattr(file, "write", refuse)
        return file

    def refuse(_: str) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "open", full)
    path = re.escape(str(tmp_path / "freshly_written.py"))
    with pytest.raises(InputError, match=rf"^{path} cannot be written: No space left on device\.$"):
        write_method("freshly_written", tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "'' cannot be the name of a module"),
        ("MyMethod", "Did you mean 'my_method'?"),
        ("MyMethod2", "Did you mean 'my_method2'?"),
        ("my-method", "digits and _. Did you mean 'my_method'?"),
        ("2fast", "Did you mean 'fast'?"),
        ("_mine", "Did you mean 'mine'?"),
        ("méthode", "cannot be the name of a module"),
        ("../mine", "Did you mean 'mine'?"),
        ("mine.py", "Did you mean 'mine_py'?"),
        ("m" * 51, "at most 50 lowercase letters"),
        ("lambda", "'lambda' is a Python keyword"),
        ("none", "'None' is a Python keyword. Did you mean 'none_method'?"),
        ("sft", "'sft' is a built-in method. Did you mean 'my_sft'?"),
        ("s_f_t", "would take for 'sft'"),
        ("nul", "the name of a device on Windows"),
        ("torch", "A module named 'torch' already exists. Did you mean 'torch_method'?"),
    ],
)
def test_an_impossible_name_is_refused_with_the_reason_and_nothing_is_written(
    name: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        write_method(name, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("there", ["mine.py", "test_mine.py"])
def test_no_file_is_overwritten_and_none_is_left_alone(there: str, tmp_path: Path) -> None:
    (tmp_path / there).write_text("mine", encoding="utf-8")
    with pytest.raises(ValueError, match=rf"{there} cannot be written: File exists."):
        write_method("mine", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [there]
    assert (tmp_path / there).read_text(encoding="utf-8") == "mine"


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine.py").symlink_to(tmp_path / "elsewhere.py")
    with pytest.raises(ValueError, match="File exists"):
        write_method("mine", tmp_path)
    assert not (tmp_path / "elsewhere.py").exists()


def test_a_bad_name_or_folder_ends_the_command_with_one_line(
    tmp_path: Path, clbench: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (("sft",), ("mine", "--folder", "nowhere")):
        with pytest.raises(SystemExit) as ended:
            clbench("new-method", *arguments)
        said = capsys.readouterr().err
        assert ended.value.code == 2
        assert len(said.splitlines()) == 1
        assert said.startswith("error: ")
    assert list(tmp_path.iterdir()) == []


def test_the_class_is_named_after_the_module() -> None:
    assert [class_name(name) for name in ("ewc", "my_method", "a__b2")] == ["Ewc", "MyMethod", "AB2"]


@pytest.mark.long
def test_a_record_counts_only_for_the_code_that_its_policy_has_now(fresh_policy: str, tmp_path: Path) -> None:
    spec, records = RunSpec(TINY.id, "frozen", 0, policy=fresh_policy), tmp_path / "records"
    module = tmp_path / "fresh_policy.py"
    made = module.read_text(encoding="utf-8")
    execute(spec, records)
    assert has_record(spec.resolve(), records)
    module.write_text(f"{made}\n_CHANGED = 1\n", encoding="utf-8")
    assert not has_record(spec.resolve(), records)
    said = set_aside(spec.resolve(), records)
    assert said is not None
    assert (
        f"the code of {fresh_policy} has changed since this run. The record is renamed to seed-0.json.old"
        in said
    )


@pytest.mark.long
@pytest.mark.usefixtures("fresh_policy")
def test_a_record_counts_only_for_the_weights_that_its_policy_brings_now(tmp_path: Path) -> None:
    own_weights(tmp_path, "0.5")
    spec, records = RunSpec(TINY.id, "frozen", 0, policy="own_policy:Own"), tmp_path / "records"
    execute(spec, records)
    own_weights(tmp_path, "0.25")
    assert not has_record(spec.resolve(), records)
    own_weights(tmp_path, "0.5")
    assert has_record(spec.resolve(), records)
    own_weights(tmp_path, "0.25")
    said = set_aside(spec.resolve(), records)
    assert said is not None
    assert (
        "the weights of own_policy:Own have changed since this run. The record is renamed to seed-0.json.old"
        in said
    )


@pytest.mark.long
@pytest.mark.usefixtures("fresh_policy")
def test_an_older_record_that_names_no_weights_counts(tmp_path: Path) -> None:
    own_weights(tmp_path, "0.5")
    spec, records = RunSpec(TINY.id, "frozen", 0, policy="own_policy:Own"), tmp_path / "records"
    record = execute(spec, records)
    del record.fingerprint["weights"]
    write_record(record, spec.path(records))
    assert has_record(spec.resolve(), records)
