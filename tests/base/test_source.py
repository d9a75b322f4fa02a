"""Hashes of source code: a cache key covers all code of its stage, and every module it names exists."""

import errno
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers import output_of

from clbench.base.source import (
    DATA_SOURCES,
    RUN_SOURCES,
    TRAINING_SOURCES,
    files_below,
    source_hash,
)

STAGES = {
    "demonstrations": (
        DATA_SOURCES,
        "from clbench.data.demonstrations import dataset_folder\n"
        "dataset_folder(scenario.target[0], scenario.budget)",
    ),
    "questions": (
        DATA_SOURCES,
        "from clbench.data.questions import load_questions\nload_questions(scenario)",
    ),
    "pretraining": (
        TRAINING_SOURCES,
        "from clbench.learning.pretraining import pretrained_policy\npretrained_policy(scenario, 0)",
    ),
    "run": (
        (*RUN_SOURCES, "clbench.methods"),
        "from clbench.runs.run import execute\nfrom clbench.runs.spec import RunSpec\n"
        "execute(RunSpec('clbench.testing:clbench/Toy-v0', 'sft', 0, targets=1), 'records')",
    ),
}
"""Stages that are cached: the packages that their keys name, and code that does all of the stage."""

ELSEWHERE = ("clbench.envs", "clbench.testing")
"""Suites: keys name the package of each task. The toy's package is `clbench.testing`."""


PROGRAM = """
import os, sys
import minari, torch, torch._inductor.config  # they take seconds, and import nothing of clbench
assert not any(name.startswith("clbench") for name in sys.modules)
for stage, code in {codes}.items():
    if not os.fork():
        from clbench.spec.registry import load_scenario
        scenario = load_scenario("clbench.testing:clbench/Toy-v0")
        exec(code)
        print(stage, *(name for name in sys.modules if name.startswith("clbench.")), flush=True)
        os._exit(0)
    assert os.wait()[1] == 0
"""
"""Does each stage in a process of its own, and prints the modules that it imported."""


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Return the names of the modules that each stage imports."""
    program = PROGRAM.format(codes={stage: code for stage, (_, code) in STAGES.items()})
    command, folder = [sys.executable, "-c", program], tmp_path_factory.mktemp("stages")
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    lines = [line.split() for line in result.stdout.splitlines()]
    return {stage: names for stage, *names in lines if stage in STAGES}


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_a_key_names_every_package_that_its_stage_imports(stage: str, imported: dict[str, list[str]]) -> None:
    packages, _ = STAGES[stage]
    covered = (*packages, *ELSEWHERE)
    names = imported[stage]
    assert [name for name in names if not f"{name}.".startswith(tuple(f"{one}." for one in covered))] == []
    used = {package for package in packages for name in names if f"{name}.".startswith(f"{package}.")}
    assert used == set(packages), "the key names packages that its stage does not use"


def test_a_module_that_does_not_exist_is_refused_by_name() -> None:
    for name in ("clbench.pretrainning", "clbench.no.such", "nowhere"):
        with pytest.raises(ModuleNotFoundError, match=name.rpartition(".")[0] or name):
            source_hash("clbench.policy", name)


def test_a_change_of_a_file_below_a_package_changes_its_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / "some_package" / "inside"
    deep.mkdir(parents=True)
    for folder in (deep.parent, deep):
        (folder / "__init__.py").touch()
    (deep / "words.txt").write_text("one")
    monkeypatch.syspath_prepend(tmp_path)
    before = source_hash("some_package")
    assert source_hash("some_package") == before
    (deep / "words.txt").write_text("three")
    assert source_hash("some_package") != before


def test_a_folder_of_code_that_cannot_be_listed_is_not_taken_for_an_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "code.py").touch()
    (tmp_path / ".#code.py").symlink_to("nowhere")  # an editor's
    assert files_below(tmp_path) == [tmp_path / "below" / "code.py"]

    def refuse(path: str) -> Iterator[os.DirEntry[str]]:
        if Path(path).name == "below":
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), path)
        return usual(path)

    usual = os.scandir
    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(OSError, match="Stale file handle"):
        files_below(tmp_path)


def test_what_python_numba_and_editors_keep_beside_code_does_not_change_a_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "some_compiled_package"
    package.mkdir()
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    before = source_hash("some_compiled_package")
    (package / "__pycache__").mkdir(exist_ok=True)
    for name in ("arm.cpython-311.pyc", "arm._drive-112.py311.nbi", "arm._drive-112.py311.1.nbc"):
        (package / "__pycache__" / name).write_bytes(b"compiled")
    (package / ".arm.py.swp").write_bytes(b"edited")
    assert source_hash("some_compiled_package") == before


LAYOUTS = {
    "a module that imports one beside it": ("mine", {"mine.py": "import near", "near.py": ""}, "near.py"),
    "through another one": (
        "mine",
        {"mine.py": "import near", "near.py": "def f():\n    from far.deep import x", "far/deep.py": "x = 1"},
        "far/deep.py",
    ),
    "another package of the same top": (
        "top.methods.mine",
        {
            "top/__init__.py": "",
            "top/methods/__init__.py": "",
            "top/methods/mine.py": "from ..tools import loss",
            "top/tools/__init__.py": "",
            "top/tools/loss.py": "",
        },
        "top/tools/loss.py",
    ),
    "what Python runs of a package": (
        "mine",
        {"mine.py": "import near.deep", "near/__init__.py": "", "near/deep.py": ""},
        "near/__init__.py",
    ),
}
"""Modules of users: their names, their files, and the file that their keys must follow."""


@pytest.fixture
def lay_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[dict[str, str]], None]]:
    """Return a function that writes files below a folder on Python's path; their modules are forgotten."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(tmp_path)

    def write(files: dict[str, str]) -> None:
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
        importlib.invalidate_caches()

    yield write
    for name in set(sys.modules) - before:
        if Path(getattr(sys.modules[name], "__file__", None) or "/").is_relative_to(tmp_path):
            del sys.modules[name]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_change_of_a_file_that_a_module_imports_from_beside_it_changes_its_hash(
    layout: str, lay_out: Callable[[dict[str, str]], None]
) -> None:
    module, files, helper = LAYOUTS[layout]
    lay_out({**files, "unrelated.py": "one"})
    before = source_hash(module)
    lay_out({"unrelated.py": "another"})
    assert source_hash(module) == before
    lay_out({helper: "changed = True"})
    assert source_hash(module) != before


def test_what_is_installed_and_what_is_in_clbench_does_not_count_with_a_module_that_imports_it(
    lay_out: Callable[[dict[str, str]], None],
) -> None:
    lay_out({"alone.py": "import numpy, clbench\nfrom clbench.methods import lora\nimport nothing_here"})
    before = source_hash("alone")
    lay_out({"clbench/methods/lora.py": "", "clbench/__init__.py": ""})
    assert source_hash("alone") == before


def test_what_is_installed_beside_an_installed_module_does_not_count_with_it(
    tmp_path: Path, lay_out: Callable[[dict[str, str]], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = "site-packages/"
    lay_out({folder + "plug/mine.py": "import other\nfrom plug.tools import loss", folder + "other.py": ""})
    lay_out({folder + "plug/tools/loss.py": ""})
    monkeypatch.syspath_prepend(tmp_path / "site-packages")
    before = source_hash("plug.mine")
    lay_out({folder + "other.py": "changed = True"})
    assert source_hash("plug.mine") == before
    lay_out({folder + "plug/tools/loss.py": "changed = True"})
    assert source_hash("plug.mine") != before


PLAIN = """import math
WIDTH = 3.0
TEXT = '''one

# two
'''
PARTS = [
    "hand",
]
NAME = \\
    "left"
class Arm:
    reach = (1, "a")
    def move(self, by):
        if by:
            return f"{math.pi * by}" "m"
        return "still"
"""
"""A module with statements of all kinds, and a text that looks like a comment inside."""

SAME = {
    "comments": PLAIN.replace("3.0", "3.0  # metres").replace("    def", "    # how far\n    def"),
    "docstrings": '"About arms."\n' + PLAIN.replace("by):", "by):\n        r'''Move.\n\n        Far.'''"),
    "what follows a value": PLAIN.replace("3.0", "3.0\n'''Width of\n\nan arm.'''"),
    "blank lines": PLAIN.replace("WIDTH", "\n\nWIDTH").replace("        if", "\n        if"),
}
"""The same code, told otherwise."""

OTHER = {
    "a number": PLAIN.replace("3.0", "3.1"),
    "an operator": PLAIN.replace("*", "/"),
    "a text": PLAIN.replace('"still"', '"rests"'),
    "a part of a text": PLAIN.replace('"m"', '"cm"'),
    "a line of a text that looks like a comment": PLAIN.replace("# two", "# three"),
    "a blank line of a text": PLAIN.replace("one\n\n", "one\n"),
    "the depth of a line": PLAIN.replace('        return "still"', '            return "still"'),
    "a text that a statement begins with": PLAIN.replace("WIDTH", "'WIDTH'.lower()\nWIDTH"),
    "a text alone in its line, inside of brackets": PLAIN.replace("hand", "foot"),
    "a text alone in its line, which goes on": PLAIN.replace("left", "right"),
    "a name": PLAIN.replace("reach", "grasp"),
}
"""Other code."""


@pytest.mark.parametrize("change", SAME)
def test_comments_docstrings_and_blank_lines_do_not_change_a_hash(
    change: str, lay_out: Callable[[dict[str, str]], None]
) -> None:
    lay_out({"mine.py": PLAIN})
    before = source_hash("mine")
    assert SAME[change] != PLAIN
    lay_out({"mine.py": SAME[change]})
    assert source_hash("mine") == before


@pytest.mark.parametrize("change", OTHER)
def test_any_change_of_the_code_changes_its_hash(
    change: str, lay_out: Callable[[dict[str, str]], None]
) -> None:
    lay_out({"mine.py": PLAIN})
    before = source_hash("mine")
    compile(OTHER[change], "mine.py", "exec")
    assert OTHER[change] != PLAIN
    lay_out({"mine.py": OTHER[change]})
    assert source_hash("mine") != before


def test_a_text_inside_of_a_formatted_one_counts(lay_out: Callable[[dict[str, str]], None]) -> None:
    """Python 3.12 allows the quotation marks of the outer text inside, where a part looks like a comment."""
    lay_out({"mine.py": 'print(f"{names["#1"]}")\n'})
    before = source_hash("mine")
    lay_out({"mine.py": 'print(f"{names["#2"]}")\n'})
    assert source_hash("mine") != before


def test_a_file_that_python_cannot_read_counts_with_its_bytes(
    lay_out: Callable[[dict[str, str]], None],
) -> None:
    lay_out({"mine.py": "def later():\n    import torn", "torn.py": "def ("})
    before = source_hash("mine")
    lay_out({"torn.py": "def (("})
    assert source_hash("mine") != before


def test_the_order_in_which_packages_are_named_does_not_matter() -> None:
    assert source_hash("clbench.policy", "clbench.spec") == source_hash("clbench.spec", "clbench.policy")


@pytest.mark.long
def test_a_class_typed_at_a_prompt_has_a_hash() -> None:
    code = "from clbench.base.source import source_hash; print(len(source_hash('__main__')))"
    assert output_of(code) == "16"


@pytest.mark.long
def test_a_script_on_standard_input_has_no_source() -> None:
    code = "from clbench.base.source import has_source; print(has_source('__main__'))"
    command = [sys.executable, "-"]
    result = subprocess.run(command, input=code, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"
