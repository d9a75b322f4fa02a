"""The hand-written documents: their links, and the versions that several files repeat."""

import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers import blocks_of

from clbench.cli.main import app

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")], key=lambda path: path.relative_to(ROOT).as_posix()
)

COMMANDS = [
    line.removeprefix("$ ")
    for page in (ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md")))
    for language in ("console", "shell")
    for block in blocks_of(page, language)
    for line in block.replace("\\\n", " ").splitlines()
    if line.removeprefix("$ ").startswith("clbench ")
]
"""Commands that the README and the guides show."""


def _links(text: str) -> Iterator[str]:
    """Yield the targets of the links of a page that lead to files."""
    plain = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    yield from (link for link in re.findall(r"\]\(([^)\s]+)\)", plain) if not link.startswith("http"))


def _anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub writes them."""
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_of_a_document_leads_to_a_file_and_a_heading(page: Path) -> None:
    broken = []
    for link in _links(page.read_text(encoding="utf-8")):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        there = target.exists()
        if there and anchor and target.suffix == ".md":
            there = anchor in _anchors(target.read_text(encoding="utf-8"))
        if not there:
            broken.append(link)
    assert broken == []


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_by_a_name_has_a_line_that_defines_it(page: Path) -> None:
    plain = re.sub(r"```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    defined = re.findall(r"^\[([^\]]+)\]: \S+$", plain, flags=re.MULTILINE)
    assert set(re.findall(r"\[[^\[\]]+\]\[([^\[\]]{2,})\]", plain)) == set(defined)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_a_guide_shows_is_taken_by_the_command_line(command: str) -> None:
    app.parse_args(shlex.split(command, comments=True)[1:], exit_on_error=False, print_error=False)


def _text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_citation_has_the_version_and_the_licence_of_the_package() -> None:
    project = tomllib.loads(_text("pyproject.toml"))["project"]
    citation = dict(re.findall(r"^(version|license): (.+)$", _text("CITATION.cff"), flags=re.MULTILINE))
    released = re.findall(r"^## (\d\S*) \(", _text("CHANGELOG.md"), flags=re.MULTILINE)
    version = released[0] if released and ".dev" in project["version"] else project["version"]
    assert citation == {"version": version, "license": project["license"]}


def test_the_pre_commit_hooks_use_the_same_ruff_as_the_tests() -> None:
    development = tomllib.loads(_text("pyproject.toml"))["project"]["optional-dependencies"]["dev"]
    (pinned,) = (one.removeprefix("ruff==") for one in development if one.startswith("ruff=="))
    assert re.findall(r"rev: v(.+)", _text(".pre-commit-config.yaml")) == [pinned]


def test_the_list_of_decisions_has_every_decision() -> None:
    folder = ROOT / "docs" / "decisions"
    listed = set(_links((folder / "README.md").read_text(encoding="utf-8")))
    assert listed == {path.name for path in folder.glob("[0-9]*.md")}


def test_the_architecture_page_has_a_row_for_every_package() -> None:
    rows = set(re.findall(r"^\| `([\w.]+)` \|", _text("docs/architecture.md"), flags=re.MULTILINE))
    core = {path.parent.name for path in (ROOT / "clbench").glob("*/__init__.py")}
    parts = {
        f"{part}.{path.parent.name}"
        for part in ("envs", "leaderboard")
        for path in (ROOT / part).glob("*/__init__.py")
    }
    assert core | parts | {"methods"} == rows


def test_every_guarantee_names_tests_that_exist() -> None:
    rows = re.findall(
        r"^\| (?!promise|---)(.+) \| (.+) \|$", _text("docs/guide/guarantees.md"), flags=re.MULTILINE
    )
    assert len(rows) > 10
    for promise, tests in rows:
        named = re.findall(r"`(tests/[^`]+)`", tests)
        assert named, promise
        assert [place for place in named if not (ROOT / place).exists()] == []


def test_the_page_on_pypi_has_absolute_links_alone() -> None:
    hook = tomllib.loads(_text("pyproject.toml"))["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    page = "".join(_text(fragment["path"]) for fragment in hook["fragments"])
    files = list(_links(page))
    for one in hook["substitutions"]:
        page = re.sub(one["pattern"], one["replacement"], page)
    assert list(_links(page)) == []
    for file in files:
        raw = file.endswith(".gif")
        source = "raw.githubusercontent.com/clbench/clbench" if raw else "github.com/clbench/clbench/blob"
        assert f"](https://{source}/v$HFPR_VERSION/{file})" in page


def test_the_guide_of_runs_has_a_row_for_every_extra() -> None:
    extras = tomllib.loads(_text("pyproject.toml"))["project"]["optional-dependencies"]
    guide = _text("docs/guide/runs.md").partition("## Extras")[2]
    assert sorted(re.findall(r"^\| `(\w+)` \|", guide, flags=re.MULTILINE)) == sorted(extras)
