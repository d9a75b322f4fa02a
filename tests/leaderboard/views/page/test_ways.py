"""Ways through the page: addresses, Back, where the focus goes, and tips that a reader can dismiss."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from clbench.base.entry_points import resolve

make_page = resolve("clbench.leaderboard.views.page:page")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")

EVEN = "clbench/Even-v1"

pytestmark = pytest.mark.slow


@pytest.fixture
def address(even_board: Callable[..., Path]) -> str:
    """The address of a page with four methods, which it ranks, and with a file that is not shown."""
    for method in ("sft", "finch", "lora", "l2_sp"):
        records = even_board(method, 0, 0.2)
    (records / "torn.json").write_text("{", encoding="utf-8")
    path = records.parent / "index.html"
    path.write_text(make_page(compute_board(records), {}), encoding="utf-8")
    return path.as_uri()


@pytest.fixture
def open_page(browser: Browser, address: str) -> Iterator[Callable[[str], Page]]:
    """Return a function that opens the page at a place; no script of it may fail."""
    troubles: list[str] = []
    page = browser.new_page(viewport={"width": 1280, "height": 860}, reduced_motion="reduce")
    page.set_default_timeout(300_000)  # a busy machine is slow
    page.on("pageerror", lambda error: troubles.append(str(error)))

    def open_page(place: str) -> Page:
        page.goto(f"{address}{place}")
        page.locator("html[data-ready]").wait_for()
        return page

    yield open_page
    page.close()
    assert not troubles


def row(page: Page) -> Locator:
    return page.locator("dialog[open]")


def heading(page: Page) -> Locator:
    return row(page).get_by_role("heading", level=2)


def link(page: Page, method: str) -> Locator:
    return page.locator(".board").get_by_role("link", name=method)


def test_back_to_an_address_without_a_place_shows_the_first_part(open_page: Callable[[str], Page]) -> None:
    page = open_page("")
    expect(page).to_have_title("Even-v1 · clbench leaderboard")
    page.get_by_role("link", name="1 file not shown").click()
    expect(page.locator("#not-shown")).to_be_visible()
    expect(page).to_have_title("1 file not shown · clbench leaderboard")
    page.go_back()
    expect(page.locator(f"[id='{EVEN}']")).to_be_visible()
    expect(page.locator("#not-shown")).to_be_hidden()


@pytest.mark.parametrize("place", ["#%", "#toString", f"#{EVEN}/toString"])
def test_an_address_that_names_nothing_does_no_harm(place: str, open_page: Callable[[str], Page]) -> None:
    page = open_page(place)
    expect(page.locator("figure[data-plane]:visible svg")).to_have_count(1)
    expect(page).to_have_title("Even-v1 · clbench leaderboard")
    assert row(page).count() == 0


def test_back_after_a_closed_row_leads_out_of_the_rows(open_page: Callable[[str], Page]) -> None:
    page = open_page("#not-shown")
    page.get_by_role("link", name="Even-v1").click()
    method = page.locator(".board .name a").first.inner_text()
    link(page, method).click()
    expect(page).to_have_title(f"{method} · Even-v1 · clbench leaderboard")
    row(page).locator("nav a").click()
    expect(heading(page)).not_to_have_text(method)
    page.keyboard.press("Escape")
    expect(row(page)).to_have_count(0)
    expect(page).to_have_url(re.compile(f"#{EVEN}$"))
    page.go_back()
    expect(page.locator("#not-shown")).to_be_visible()
    expect(row(page)).to_have_count(0)


@pytest.mark.parametrize("place", ["", f"#{EVEN}"])
def test_the_focus_and_the_page_return_to_the_link_that_opened_a_row(
    place: str, open_page: Callable[[str], Page]
) -> None:
    page = open_page(place)
    opener = page.locator(".definitions a, .board .name a").last
    for close in (lambda: page.keyboard.press("Escape"), page.go_back):
        opener.focus()
        page.keyboard.press("Enter")
        expect(heading(page)).to_be_focused()
        before = page.evaluate("scrollY")
        assert before > 0
        close()
        expect(page).not_to_have_url(re.compile("Even-v1/"))
        expect(opener).to_be_focused()
        assert page.evaluate("scrollY") == before


def test_the_focus_goes_to_the_table_where_an_address_opened_a_row(open_page: Callable[[str], Page]) -> None:
    page = open_page(f"#{EVEN}/lora")
    expect(heading(page)).to_be_focused()
    page.keyboard.press("Escape")
    expect(link(page, "lora")).to_be_focused()
    expect(link(page, "lora")).to_be_in_viewport()


def test_filters_that_no_method_passes_say_so(open_page: Callable[[str], Page]) -> None:
    page = open_page("")
    note, filtered = page.locator("[data-plane-note]"), page.get_by_label("Method", exact=True)
    page.get_by_label("Horizontal axis").select_option("relative cost")
    expect(note).to_contain_text("Not in the chart: ")
    filtered.fill("lora")
    expect(note).to_contain_text("lora (")
    expect(note).not_to_contain_text("finch")
    filtered.fill("zzzz")
    expect(note).to_have_text("No method matches the filters.")
    expect(page.locator("figure[data-plane] svg")).to_have_count(0)


def test_a_pointer_may_go_onto_a_tip_and_escape_hides_it(open_page: Callable[[str], Page]) -> None:
    page = open_page("")
    tip = page.get_by_role("tooltip")
    number = page.locator(".board td.numeric[data-note]").first
    number.scroll_into_view_if_needed()
    page.evaluate("() => new Promise(requestAnimationFrame)")  # scrolling hides a tip
    number.hover()
    expect(tip).to_be_visible()
    tip.hover()
    page.wait_for_timeout(400)  # longer than a tip stays that the pointer has left
    expect(tip).to_be_visible()
    page.keyboard.press("Escape")
    expect(tip).to_be_hidden()


def test_escape_hides_a_tip_first_and_then_closes_the_row(open_page: Callable[[str], Page]) -> None:
    page = open_page(f"#{EVEN}/lora")
    row(page).locator("figure svg .mark-symbol path").first.hover(force=True)
    expect(page.get_by_role("tooltip")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_role("tooltip")).to_be_hidden()
    expect(row(page)).to_have_count(1)
    page.keyboard.press("Escape")
    expect(row(page)).to_have_count(0)


def chosen(page: Page) -> dict[str, str]:
    """Return what the reader has chosen: the quantities, the filter, and the column that sorts the table."""
    part = page.locator(".part:not([hidden])")
    head = part.locator(".board thead th:not([aria-sort=none])")
    title = head.locator("button").inner_text().partition(" lower")[0].strip()
    return {
        "across": part.get_by_label("Horizontal axis").input_value(),
        "text": part.get_by_label("Method", exact=True).input_value(),
        "all": str(part.get_by_label("all columns").is_checked()),
        "sorted": f"{title} {head.get_attribute('aria-sort')}",
        "first": part.locator(".board tbody tr:not(.division-head):visible .name").first.inner_text(),
    }


def test_choices_survive_a_reload_and_the_way_back_and_a_link_hands_them_on(
    open_page: Callable[[str], Page], browser: Browser
) -> None:
    page = open_page("")
    part = page.locator(".part:not([hidden])")
    usual = chosen(page)
    part.get_by_label("Horizontal axis").select_option("bytes kept")
    part.get_by_label("Method", exact=True).fill("f")
    part.get_by_label("all columns").check()
    part.locator(".board thead button", has_text="learned").click()
    part.locator(".board thead button", has_text="learned").click()
    mine = chosen(page)
    assert mine["sorted"] == "learned ascending"
    assert mine != usual
    page.reload()
    page.locator("html[data-ready]").wait_for()
    assert chosen(page) == mine
    page.goto("about:blank")
    page.go_back()
    page.locator("html[data-ready]").wait_for()
    assert chosen(page) == mine
    part.locator(".board .name a").first.click()
    row(page).get_by_text("Close").click()
    assert chosen(page) == mine
    address = page.url
    other = browser.new_page()
    other.goto(address)
    other.locator("html[data-ready]").wait_for()
    assert chosen(other) == mine
    other.close()


def test_a_link_with_choices_holds_in_a_page_that_is_open(open_page: Callable[[str], Page]) -> None:
    page = open_page(f"#{EVEN}")
    usual = chosen(page)
    page.evaluate(
        "(hash) => { location.hash = hash; }", f"{EVEN}?across=bytes+kept&sort=learned&order=ascending"
    )
    expect(page.locator(".part:not([hidden])").get_by_label("Horizontal axis")).to_have_value("bytes kept")
    mine = chosen(page)
    assert mine["sorted"] == "learned ascending"
    assert "sort=learned" in page.url
    page.locator(".part:not([hidden]) .board .name a").first.click()
    page.reload()
    page.locator("html[data-ready]").wait_for()
    row(page).get_by_text("Close").click()
    expect(row(page)).to_have_count(0)
    page.go_back()
    assert usual != mine


def test_a_link_may_be_percent_encoded(open_page: Callable[[str], Page]) -> None:
    page = open_page(f"#{EVEN.replace('/', '%2F')}?sort=learned&order=ascending")
    assert chosen(page)["sorted"] == "learned ascending"


def test_the_tab_key_reaches_a_number_whatever_is_filtered(open_page: Callable[[str], Page]) -> None:
    page = open_page(f"#{EVEN}")
    part = page.locator(".part:not([hidden])")
    stops = part.locator(".board td[data-note][tabindex='0']:visible")
    first = stops.locator("xpath=..").get_attribute("data-division")
    assert first is not None
    name = part.locator(".board tbody tr:visible .name").last.inner_text()
    part.get_by_label("Method", exact=True).fill(name)
    expect(stops).to_have_count(1)


def test_choices_that_the_page_does_not_know_are_ignored(open_page: Callable[[str], Page]) -> None:
    usual = chosen(open_page(""))
    assert chosen(open_page(f"#{EVEN}?across=nothing&sort=nothing&order=sideways&all=perhaps&text=")) == usual


def test_the_meaning_of_a_definition_is_reached_by_keyboard(open_page: Callable[[str], Page]) -> None:
    page = open_page(f"#{EVEN}")
    heads = page.locator(".part:not([hidden]) .definitions .turned[data-note]")
    heads.first.focus()
    expect(page.locator("#tip")).to_be_visible()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#tip")).to_have_text(heads.nth(1).get_attribute("data-note") or "")


@pytest.mark.parametrize(("allowed", "then"), [(True, "Copied"), (False, "Selected")])
def test_a_click_copies_the_commands_of_a_row_or_selects_them(
    allowed: bool, then: str, open_page: Callable[[str], Page]
) -> None:
    page = open_page(f"#{EVEN}/sft")
    page.evaluate(
        """allowed => Object.defineProperty(navigator, "clipboard", {value: {
            writeText: async (text) => { if (!allowed) throw new Error("forbidden"); window.copied = text; }
        }})""",
        allowed,
    )
    page.get_by_role("button", name="Copy").click()
    expect(page.get_by_role("button", name=then)).to_be_visible()
    commands = page.locator("dialog pre").inner_text()
    assert "clbench run" in commands
    assert (
        page.evaluate("allowed => allowed ? window.copied : getSelection().toString()", allowed).strip()
        == commands.strip()
    )
