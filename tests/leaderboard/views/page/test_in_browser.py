"""The page in a browser, opened from disk: what a reader does by mouse, by keys, on a phone, in the dark."""

import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Locator, Page, Request, expect

from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record

HOSTILE = "</script><img src=x onerror=alert(1)>"
REPLAY = {"demonstrations": "throughout", "questions": "never", "reference": False}
MATRIX = np.array([[1.0, 0.8, 0.1, 0.0, 0.2], [0.6, 0.9, 0.9, 0.2, 0.3], [0.5, 0.4, 0.3, 0.8, 0.1]])
DESKTOP, PHONE = {"width": 1280, "height": 860}, {"width": 390, "height": 844}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def address(make_record: Callable[..., Record], tmp_path_factory: pytest.TempPathFactory) -> str:
    """The address of a page with three scenarios, and strange names on it."""
    records = tmp_path_factory.mktemp("board") / "records"

    def add(method: str, seed: int, change: float, scenario: str = "clbench/Toy-v0", **run: Any) -> None:
        record = make_record(
            np.clip(MATRIX + change, 0, 1),
            method=method,
            seed=seed,
            episodes=10,
            curves=np.full((2, 3), 0.4),
            retained_curves=np.full((2, 3, 2), 0.7),
            scenario=scenario,
            **run,
        )
        record.diagnostics = {str(stage): {HOSTILE: HOSTILE, "share": 0.1, "way": [1, 3]} for stage in (1, 2)}
        record.fingerprint["hardware"] = {"processor": HOSTILE}
        write_record(record, record_path(records, scenario, method, seed))

    for seed in range(2):
        for number, method in enumerate(("sft", "l2", "other", "x_with_a_name_that_is_longer_than_a_phone")):
            add(method, seed, number / 10)
        add("replay", seed, 0.2, uses=REPLAY)
        add("sft", seed, seed / 5, scenario="clbench/Other-v0")
        add("alone", seed, 0.1, scenario="clbench/Without-v0")
    (records / f"{HOSTILE.replace('/', '')}.json").write_text("{", encoding="utf-8")
    (records / "torn.json").write_text("{", encoding="utf-8")
    page = resolve("clbench.leaderboard.views.page:page")(
        resolve("clbench.leaderboard.board.rows:compute_board")(records), {}
    )
    path = records.parent / "index.html"
    path.write_text(page, encoding="utf-8")
    return path.as_uri()


@pytest.fixture
def open_page(browser: Browser, address: str) -> Iterator[Callable[..., Page]]:
    """Return a function that opens the page; it must ask no network, and no script of it may fail."""
    troubles: list[str] = []

    def check(request: Request) -> None:
        if request.url.partition("#")[0] != address:
            troubles.append(request.url)

    def open_page(place: str = "", **context: Any) -> Page:
        made = browser.new_context(**{"viewport": DESKTOP, "reduced_motion": "reduce", **context})
        page = made.new_page()
        page.set_default_timeout(300_000)  # a busy machine is slow
        page.on("console", lambda message: troubles.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("dialog", lambda dialog: troubles.append(f"dialog: {dialog.message}"))
        page.on("request", check)
        page.goto(f"{address}#{place}")
        if context.get("java_script_enabled", True):
            page.locator("html[data-ready]").wait_for()
        return page

    yield open_page
    for context in browser.contexts:
        context.close()
    assert not troubles


def names(page: Page, scenario: str = "clbench/Toy-v0") -> list[str]:
    """Return the methods of a table from top to bottom."""
    return page.locator(
        f"[id='{scenario}'] .board tbody tr:not(.division-head):visible .name"
    ).all_inner_texts()


def head(page: Page, title: str) -> Locator:
    return page.locator("[id='clbench/Toy-v0'] .board thead th").filter(
        has=page.get_by_role("button", name=re.compile(f"^{title}"))
    )


def row(page: Page) -> Locator:
    return page.locator("dialog[open]")


def test_it_opens_from_disk_and_draws_its_charts(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    expect(page.locator("figure[data-plane]:visible svg")).to_have_count(1)
    expect(page.locator("figure[data-plane]:visible")).to_contain_text("other")
    assert page.title() == "Toy-v0 · clbench leaderboard"


def test_a_click_on_a_head_sorts_and_a_second_one_the_other_way(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    assert names(page) == ["x_with_a_name_that_is_longer_than_a_phone", "other", "l2", "sft", "replay"]
    expect(head(page, "gain")).to_have_attribute("aria-sort", "descending")
    button = head(page, "method").get_by_role("button")
    button.click()
    assert names(page) == ["l2", "other", "sft", "x_with_a_name_that_is_longer_than_a_phone", "replay"]
    expect(head(page, "method")).to_have_attribute("aria-sort", "ascending")
    expect(head(page, "gain")).to_have_attribute("aria-sort", "none")
    button.press("Enter")
    assert names(page)[0] == "x_with_a_name_that_is_longer_than_a_phone"
    # lower is better first, and missing values last either way
    head(page, "relative cost").get_by_role("button").click()
    assert names(page)[:4] == ["sft", "x_with_a_name_that_is_longer_than_a_phone", "other", "l2"]
    expect(head(page, "relative cost")).to_have_attribute("aria-sort", "ascending")


def test_divisions_are_sorted_apart_until_the_reader_wants_one_list(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    page.get_by_label("sort within divisions").locator("visible=true").uncheck()
    assert names(page) == ["x_with_a_name_that_is_longer_than_a_phone", "other", "replay", "l2", "sft"]
    expect(page.locator(".division-head:visible")).to_have_count(0)
    expect(page.locator("td.division:visible")).to_have_count(5)


def test_filters_hide_rows_and_say_how_many_are_left(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    form = page.locator("[id='clbench/Toy-v0'] form")
    form.get_by_label("Method").fill("O")
    assert names(page) == ["x_with_a_name_that_is_longer_than_a_phone", "other"]
    expect(form.get_by_role("status")).to_have_text("2 of 5 methods")
    picture = page.locator("figure[data-plane]:visible svg")
    expect(picture).to_contain_text("other")
    expect(picture).not_to_contain_text("sft")
    form.get_by_label("Method").fill("")
    form.get_by_label("prior-data-free").uncheck()
    assert names(page) == ["replay"]
    expect(page.locator(".division-head:visible")).to_have_count(1)
    form.get_by_label("Method").fill("no such method")
    expect(form.get_by_role("status")).to_have_text("0 of 5 methods")
    expect(page.locator(".board:visible thead")).to_be_visible()


def test_enter_opens_a_row_and_escape_leads_back_to_it(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    link = page.locator("[id='clbench/Toy-v0'] .board").get_by_role("link", name="l2")
    link.focus()
    page.keyboard.press("Enter")
    expect(row(page)).to_contain_text("clbench run clbench/Toy-v0 l2 --seeds 2")
    expect(row(page).locator("figure svg")).to_have_count(1)
    expect(page).to_have_url(re.compile("#clbench/Toy-v0/l2$"))
    page.keyboard.press("Escape")
    expect(row(page)).to_have_count(0)
    expect(page).to_have_url(re.compile("#clbench/Toy-v0$"))
    expect(link).to_be_focused()


def test_an_address_opens_a_row_and_the_way_back_closes_it(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Other-v0/sft")
    expect(row(page).get_by_role("heading", level=2)).to_have_text("sft")
    row(page).get_by_role("link", name="Close").click()
    expect(row(page)).to_have_count(0)
    expect(page.locator("[id='clbench/Other-v0']")).to_be_visible()
    expect(page.locator("[id='clbench/Toy-v0']")).to_be_hidden()
    page.locator("[id='clbench/Other-v0'] .board .name a").click()
    expect(row(page)).to_have_count(1)
    page.go_back()
    expect(row(page)).to_have_count(0)


def test_a_row_has_each_seed_its_curves_and_every_definition(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Other-v0/sft")
    learned = row(page).locator(".matrix .learned").last
    expect(learned).to_have_text("0.90, trained in this stage")
    cells = row(page).locator(".matrix tbody")
    mean = cells.inner_html()
    row(page).get_by_role("button", name="seed 1").click()
    expect(learned).to_have_text("1.00, trained in this stage")
    row(page).get_by_role("button", name="seed 0").click()
    expect(learned).to_have_text("0.80, trained in this stage")
    row(page).get_by_role("button", name="mean").click()
    assert cells.inner_html() == mean
    row(page).get_by_role("button", name="seed 1").click()
    expect(row(page).get_by_role("button", name="seed 1")).to_have_attribute("aria-pressed", "true")
    row(page).get_by_text("The curves as a table").click()
    curves = row(page).get_by_role("region", name="The curves")
    expect(curves.locator("tbody tr").nth(1)).to_contain_text("target_0")
    expect(curves.locator("tbody tr").nth(1)).to_contain_text("0.70 [")
    row(page).get_by_text("All other metrics and definitions").click()
    expect(row(page)).to_contain_text("forgetting mammoth")
    assert page.locator("dialog").count() == 1


def test_the_keys_lead_through_the_page_and_show_where_they_are(open_page: Callable[..., Page]) -> None:
    page = open_page()
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to the results")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("main")).to_be_focused()
    page = open_page("clbench/Toy-v0")
    met = []
    for _ in range(32):
        page.keyboard.press("Tab")
        what, ring, width = page.evaluate("""() => {
            const one = document.activeElement, style = getComputedStyle(one);
            return [one.name || one.textContent.trim(), style.outlineStyle, style.outlineWidth];
        }""")
        assert ring == "solid"
        assert width == "2px"
        met.append(what)
    order = [
        "up",
        "across",
        "text",
        "division",
        "all",
        "grouped",
        "letters",
        "method",
        "final average",
        "other",
    ]
    assert [met.index(one) for one in order] == sorted(met.index(one) for one in order)


def test_it_is_dark_where_the_system_is_and_where_the_reader_wants_it(open_page: Callable[..., Page]) -> None:
    paper = "getComputedStyle(document.body).backgroundColor"
    page = open_page(color_scheme="dark")
    assert page.evaluate(paper) == "rgb(20, 23, 27)"
    page.get_by_role("button", name="Light theme").click()
    assert page.evaluate(paper) == "rgb(255, 255, 255)"
    page.get_by_role("button", name="Dark theme").click()
    assert page.evaluate(paper) == "rgb(20, 23, 27)"


def test_on_a_phone_nothing_is_wider_than_the_screen(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0", viewport=PHONE)
    width = "document.documentElement.scrollWidth"
    expect(page.locator("figure[data-plane]:visible svg")).to_have_count(1)
    assert page.evaluate(width) == PHONE["width"]
    page.goto(f"{page.url.split('#')[0]}#clbench/Toy-v0/x_with_a_name_that_is_longer_than_a_phone")
    page.locator("html[data-ready]").wait_for()
    expect(row(page).locator("figure svg")).to_have_count(1)
    assert row(page).evaluate("e => e.scrollWidth") == PHONE["width"]
    assert page.evaluate(width) == PHONE["width"]


@pytest.mark.parametrize("color_scheme", ["light", "dark"])
@pytest.mark.parametrize("place", ["overall", "clbench/Toy-v0", "clbench/Toy-v0/l2"])
def test_axe_finds_nothing_serious(place: str, color_scheme: str, open_page: Callable[..., Page]) -> None:
    page = open_page(place, color_scheme=color_scheme, viewport=PHONE if color_scheme == "dark" else DESKTOP)
    if place != "overall":
        expect(page.locator("figure:visible svg").first).to_be_visible()
    page.locator("details").evaluate_all("all => all.forEach((one) => { one.open = true; })")
    found = Axe().run(page).response["violations"]
    serious = [
        (one["id"], one["nodes"][0]["html"][:200])
        for one in found
        if one["impact"] in ("serious", "critical")
    ]
    assert not serious


def test_texts_of_strangers_are_shown_unchanged(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0/sft")
    expect(row(page)).to_contain_text(HOSTILE)
    assert page.locator("img").count() == 0
    row(page).get_by_role("link", name="Close").click()
    page.get_by_role("link", name="2 files not shown").click()
    files = page.locator("#not-shown")
    expect(files.locator("tbody tr")).to_have_count(2)
    files.get_by_label("Path or reason").fill("onerror")
    expect(files.locator("tbody tr:visible")).to_have_count(1)
    expect(files.get_by_role("status")).to_have_text("1 of 2 files")


def elements(page: Page, part: str) -> int:
    return page.locator(f"[id='{part}'] *:not(noscript)").count()


def test_a_part_has_no_elements_until_it_is_opened(open_page: Callable[..., Page]) -> None:
    page = open_page()
    parts = page.locator(".part").evaluate_all("all => all.map((one) => one.id)")
    assert parts == ["clbench/Toy-v0", "clbench/Other-v0", "clbench/Without-v0", "overall", "not-shown"]
    assert [elements(page, part) > 0 for part in parts] == [True, False, False, False, False]
    page.get_by_role("link", name="All scenarios").click()
    expect(page.locator(".heat:visible")).to_have_count(1)
    assert [elements(page, part) > 0 for part in parts] == [True, False, False, True, False]
    page.locator(".heat thead").get_by_role("link", name="Toy-v0").first.click()
    expect(page.locator(".heat:visible")).to_have_count(0)
    expect(page.locator(".board:visible")).to_have_count(1)


def test_a_part_keeps_what_the_reader_chose_in_it(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Other-v0")
    page.get_by_label("all columns").locator("visible=true").check()
    page.get_by_role("link", name="Without-v0").click()
    page.get_by_role("link", name="Other-v0").click()
    expect(page.get_by_label("all columns").locator("visible=true")).to_be_checked()
    expect(page.locator("td.extra:visible").first).to_be_visible()


@pytest.mark.parametrize("place", ["overall", "not-shown", "clbench/Without-v0"])
def test_an_address_opens_a_part_that_was_hidden(place: str, open_page: Callable[..., Page]) -> None:
    page = open_page(place)
    assert page.locator(".part:visible").evaluate_all("all => all.map((one) => one.id)") == [place]
    assert elements(page, place) > 0
    expect(page.locator(".tabs [aria-current]")).to_have_attribute("href", f"#{place}")


def test_printing_shows_the_open_part_and_the_whole_of_its_table(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Other-v0", viewport={"width": 390, "height": 420})
    page.emulate_media(media="print")
    expect(page.locator(".part:visible")).to_have_count(1)
    expect(page.locator("[id='clbench/Other-v0'] .board")).to_be_visible()
    region = page.locator(".board-region:visible")
    assert region.evaluate(
        "one => [one.scrollHeight - one.clientHeight, getComputedStyle(one).overflow]"
    ) == [
        0,
        "visible",
    ]


def test_tabs_that_do_not_fit_take_another_line_in_a_large_window(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0", viewport={"width": 1200, "height": 700})
    links, tabs = page.locator(".tabs a"), page.locator(".tabs")
    links.evaluate_all("all => all.forEach((one) => { one.textContent += ' with a long, long name'; })")
    boxes = links.evaluate_all("all => all.map((one) => one.getBoundingClientRect().right)")
    assert max(boxes) <= 1200
    lines = tabs.evaluate("one => one.offsetHeight")
    for width, height in ((720, 700), (1200, 450)):
        page.set_viewport_size({"width": width, "height": height})
        assert tabs.evaluate("one => one.offsetHeight") < lines
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_without_scripts_the_verdicts_and_tables_are_there(open_page: Callable[..., Page]) -> None:
    page = open_page(java_script_enabled=False)
    expect(page.locator(".board:visible")).to_have_count(3)
    expect(page.locator(".heat:visible")).to_have_count(1)
    expect(page.locator("td.extra").first).to_be_visible()
    expect(page.get_by_role("button", name="Dark theme")).to_be_hidden()
    expect(page.locator(".filters:visible, .choices:visible, figure:visible")).to_have_count(0)
    assert page.evaluate("document.documentElement.scrollWidth") <= DESKTOP["width"]


def cells(page: Page) -> Locator:
    return page.locator(".board:visible td.numeric[data-note]:visible")


def test_a_focused_number_shows_its_interval_and_arrows_lead_on(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    tip = page.get_by_role("tooltip")
    expect(tip).to_be_hidden()
    cells(page).first.focus()
    expect(tip).to_have_text(re.compile(r"95 % interval from 0\.\d\d to 0\.\d\d"))
    before = cells(page).first.inner_text()
    page.keyboard.press("ArrowRight")
    expect(cells(page).nth(1)).to_be_focused()
    expect(tip).to_be_visible()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowDown")
    assert page.evaluate("document.activeElement.innerText") != before
    page.locator(".board:visible .name a").first.focus()
    expect(tip).to_be_hidden()


def test_a_tap_on_a_number_shows_its_interval(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0", viewport=PHONE, has_touch=True, is_mobile=True)
    cells(page).first.tap()
    expect(page.get_by_role("tooltip")).to_have_text(re.compile("95 % interval"))
    assert row(page).count() == 0


def test_the_reader_chooses_the_axes_and_reads_why_a_picture_is_empty(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    form = page.locator("[id='clbench/Toy-v0'] form")
    picture = page.locator("[id='clbench/Toy-v0'] figure[data-plane]")
    expect(picture).to_contain_text("learned: success on each new task")
    form.get_by_label("Vertical axis").select_option("kept skills")
    expect(picture).to_contain_text("kept skills: success on the old skills")
    form.get_by_label("Horizontal axis").select_option("relative cost")
    expect(picture).to_contain_text("relative cost, less is better")
    note = page.locator("[data-plane-note]:visible")
    expect(note).to_contain_text(
        "Not in the chart: x_with_a_name_that_is_longer_than_a_phone (no relative cost, kept skills"
    )
    page.get_by_role("link", name="Without-v0").click()
    page.get_by_label("Horizontal axis").locator("visible=true").select_option("relative cost")
    expect(page.locator("figure[data-plane]:visible svg")).to_have_count(0)
    expect(note).to_contain_text(
        "No method here has both kept and relative cost. Not in the chart: alone (no relative cost"
    )


def test_a_click_on_a_tab_leaves_the_tabs_in_their_place(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    tabs = page.locator(".tabs")
    tabs.get_by_role("link", name="Other-v0").click()
    assert page.evaluate("scrollY") == 0
    tabs.get_by_role("link", name="Toy-v0").click()
    expect(page.locator("figure[data-plane]:visible svg")).to_have_count(1)
    page.evaluate("scrollTo(0, 900)")
    at = tabs.evaluate("one => one.getBoundingClientRect().top")
    assert at == 0
    tabs.get_by_role("link", name="Other-v0").click()
    assert tabs.evaluate("one => one.getBoundingClientRect().top") == at
    page.go_back()
    expect(page.locator("[id='clbench/Toy-v0']")).to_be_visible()


def test_the_head_of_a_table_stays_below_the_tabs(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    expect(page.locator("figure[data-plane]:visible svg")).to_have_count(1)
    page.locator(".board:visible tbody tr").nth(3).evaluate("one => one.scrollIntoView({ block: 'start' })")
    head, tabs = (page.locator(one).first.bounding_box() for one in (".board:visible thead th", ".tabs"))
    assert head is not None
    assert tabs is not None
    assert abs(head["y"] - tabs["y"] - tabs["height"]) < 3


def test_no_type_is_smaller_than_12_pixels(open_page: Callable[..., Page]) -> None:
    page = open_page("clbench/Toy-v0")
    expect(page.locator("figure[data-plane]:visible svg")).to_have_count(1)
    smallest = page.evaluate("""() => Math.min(...[...document.body.querySelectorAll("*")]
        .filter((one) => one.checkVisibility() && [...one.childNodes].some((part) => part.nodeType === 3
            && part.data.trim()))
        .map((one) => parseFloat(getComputedStyle(one).fontSize)))""")
    assert smallest >= 12
