"""The documentation as a site: every page and every public name is on it."""

import re
from pathlib import Path

import clbench

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def test_every_page_of_the_documentation_is_in_the_table_of_contents() -> None:
    contents = (DOCS / "_toc.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r"(?:root|file): (\S+)", contents))
    for pattern in re.findall(r"glob: (\S+)", contents):
        listed |= {page.relative_to(DOCS).with_suffix("").as_posix() for page in DOCS.glob(f"{pattern}.md")}
    pages = [*DOCS.rglob("*.md"), *DOCS.glob("notebooks/*.ipynb")]
    assert listed == {page.relative_to(DOCS).with_suffix("").as_posix() for page in pages}


def test_the_reference_shows_every_public_name() -> None:
    page = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\.\. auto\w+:: clbench\.(\S+)$", page, flags=re.MULTILINE)
    assert sorted(name.removeprefix("leaderboard.") for name in shown) == sorted(clbench.__all__)
