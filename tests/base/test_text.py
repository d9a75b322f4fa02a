"""Texts for people: words of strangers are shown, and have no other effect."""

import io

import pytest
from rich.console import Console

from clbench.base.text import (
    counted,
    did_you_mean,
    html_table,
    listed,
    print_plain,
    printable,
    printable_lines,
    quoted,
    shortened,
)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain Ünïcode", "plain Ünïcode"),
        ("\x1b[31mred", "\\x1b[31mred"),
        ("two\nlines", "two\\nlines"),
        ("\u202eright to left", "\\u202eright to left"),
    ],
)
def test_what_controls_a_terminal_is_shown_as_an_escape(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_lines_stay_lines() -> None:
    assert printable_lines("one\ntwo\x07") == "one\ntwo\\x07"


def test_a_long_text_is_cut() -> None:
    assert quoted("a\n") == r"'a\n'"
    assert quoted("x" * 61) == "'" + "x" * 60 + "'..."


def test_one_thing_is_singular() -> None:
    assert [counted(number, "seed") for number in (0, 1, 2)] == ["0 seeds", "1 seed", "2 seeds"]
    assert counted(2, "policy", "policies") == "2 policies"


def test_parts_are_listed_as_in_a_sentence() -> None:
    assert [listed("abc"[:count]) for count in range(4)] == ["", "a", "a and b", "a, b and c"]


def test_the_nearest_known_name_is_offered_if_one_is_near() -> None:
    assert did_you_mean("aegs", ["aegis", "sft"]) == " Did you mean 'aegis'?"
    assert did_you_mean("replay", ["aegis", "sft"]) == ""
    assert did_you_mean("EWC", ["aegis", "ewc"]) == " Did you mean 'ewc'?"
    assert did_you_mean("Fetch", ["clbench/Fetch-v1", "me/Other-v0"]) == " Did you mean 'clbench/Fetch-v1'?"


def test_an_html_table_has_every_cell_and_no_markup_of_its_texts() -> None:
    text = html_table("<b>", ("name", "<i>"), [("a", 1), (("x & y", "<script>"), None)])
    assert text == (
        "<p>&lt;b&gt;</p><table><thead><tr><th>name</th><th>&lt;i&gt;</th></tr></thead><tbody>"
        "<tr><td>a</td><td>1</td></tr><tr><td>x &amp; y<br>&lt;script&gt;</td><td>None</td></tr>"
        "</tbody></table>"
    )


def test_a_long_text_is_cut_with_where_the_whole_one_is() -> None:
    assert shortened("x" * 500, "seed-0.json") == "x" * 500
    assert shortened("x" * 501, "seed-0.json") == f"{'x' * 500} [... seed-0.json has the rest]"


def test_plain_text_is_printed_as_it_is() -> None:
    text = "my:cat:Policy [bold]is[/bold] " + "long " * 40 + "42"
    console = Console(file=io.StringIO(), width=40, force_terminal=True)
    print_plain(console, text)
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue() == f"{text}\n"
