"""The documentation as a site: it has every page, command and public name, and its links lead somewhere."""

import builtins
import inspect
import re
import runpy
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import clbench
import clbench.testing
from clbench.cli.data import DEMONSTRATIONS
from clbench.cli.main import COMMANDS, EXPERTS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {
    path.relative_to(DOCS).with_suffix("").as_posix(): path
    for path in (*DOCS.rglob("*.md"), *DOCS.glob("notebooks/*.ipynb"))
}
SITE: dict[str, Any] = runpy.run_path(str(DOCS / "conf.py"))


def test_every_page_of_the_documentation_is_in_the_table_of_contents() -> None:
    contents = (DOCS / "_toc.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r"(?:root|file): (\S+)", contents))
    for pattern in re.findall(r"glob: (\S+)", contents):
        listed |= {page.relative_to(DOCS).with_suffix("").as_posix() for page in DOCS.glob(f"{pattern}.md")}
    assert listed == PAGES.keys()


def test_every_link_out_of_the_documentation_leads_to_a_file_of_the_repository() -> None:
    leading_out = []
    for page, path in PAGES.items():
        source = [path.read_text(encoding="utf-8")]
        SITE["lead_out"](None, page, source)
        for link in re.findall(r"\]\(((?:\.\./)+[^)#\s]+)", source[0]):
            assert (path.parent / link).resolve().is_relative_to(DOCS), (page, link)
        leading_out += re.findall(rf"{SITE['REPOSITORY']}/([^)\s]+)", source[0])
    assert "CONTRIBUTING.md#add-a-method" in leading_out
    assert [link for link in leading_out if not (ROOT / link.partition("#")[0]).exists()] == []


def test_the_site_has_the_leaderboard_and_every_picture_that_a_page_has_in_html(tmp_path: Path) -> None:
    SITE["add_files"](SimpleNamespace(builder=SimpleNamespace(format="html"), outdir=tmp_path), None)
    pictures = [
        tmp_path / path.parent.relative_to(DOCS) / picture
        for path in DOCS.rglob("*.md")
        for picture in re.findall(r'src(?:set)?="([^"]+)"', path.read_text(encoding="utf-8"))
    ]
    assert len(pictures) >= 2
    assert [path for path in (tmp_path / "leaderboard" / "index.html", *pictures) if not path.exists()] == []


def test_the_reference_of_the_command_line_shows_every_command() -> None:
    text = SITE["help_of_commands"]()
    commands = {name for group in COMMANDS.values() for name in group}
    commands |= {"demonstrations", *(f"demonstrations {name}" for name in DEMONSTRATIONS)}
    commands |= {"experts", *(f"experts {name}" for name in EXPERTS)}
    assert set(re.findall(r"^##+ clbench (.+)$", text, flags=re.MULTILINE)) == commands
    usages = set(re.findall(r"^clbench (.+?) \[OPTIONS\]", text, flags=re.MULTILINE))
    assert usages == commands - {"experts"}  # which does nothing by itself
    assert "[`run`](#clbench-run): Run METHODS on SCENARIOS" in text
    assert "[`export`](#clbench-demonstrations-export): Export the demonstrations" in text
    assert "* `--seeds INT>=1`: Number of seeds." in text
    assert "as `--set.name` value" in text
    assert str(ROOT) not in text


def test_the_reference_shows_every_public_name_and_the_parts_of_a_record() -> None:
    page = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\.\. (?:auto|py:)\w+:: clbench\.(\S+)$", page, flags=re.MULTILINE)
    public = {*clbench.__all__} - {"plot"}
    public |= {f"plot.{name}" for name in clbench.plot.__all__}
    public |= {f"testing.{name}" for name in dir(clbench.testing)}
    rows = ("EpisodeRow", "AnswerRow", "PolicyRow", "CheckRow")
    parts = {f"records.record.{name}" for name in ("RunInfo", "ScenarioInfo", *rows, "Relearning", "Costs")}
    assert sorted(shown) == sorted(public | parts)


def _docstrings() -> Iterator[str]:
    """Yield the docstrings of all public names, and of their members."""
    names = [getattr(module, name) for module in (clbench, clbench.testing) for name in dir(module)]
    for value in names:
        members = vars(value) if inspect.isclass(value) or inspect.ismodule(value) else {}
        public = [member for name, member in members.items() if not name.startswith("_")]
        yield from (inspect.getdoc(each) or "" for each in (value, *public))


def test_every_error_that_a_public_name_raises_is_public() -> None:
    raised = {
        error
        for text in _docstrings()
        for section in re.findall(r"^Raises:\n((?: +.*\n?)+)", text, flags=re.MULTILINE)
        for error in re.findall(r"^ {4}(\w+Error):", section, flags=re.MULTILINE)
    }
    assert "InputError" in raised
    assert raised <= {*dir(clbench), *dir(clbench.testing), *dir(builtins)}


def test_no_docstring_has_a_colon_where_sphinx_takes_what_precedes_it_for_a_type() -> None:
    returned = [
        line for text in _docstrings() for line in re.findall(r"^Returns:\n +(.*)", text, flags=re.MULTILINE)
    ]
    assert len(returned) >= 5
    assert [line for line in returned if ":" in re.sub(r"`[^`]*`", "", line)] == []


def test_make_alone_names_every_target() -> None:
    shown = subprocess.run(["make"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    (targets,) = re.findall(r"^\.PHONY: help (.+)$", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    assert set(re.findall(r"^make (\S+)  ", shown, flags=re.MULTILINE)) == set(targets.split())
