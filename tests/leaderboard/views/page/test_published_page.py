"""The published page: what a researcher learns from its first screen, and how soon."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Locator, Page, expect

SITE = Path(__file__).parents[4] / "leaderboard" / "site"
SIZES = [{"width": 1440, "height": 900}, {"width": 390, "height": 844}]
MAIN = "clbench/Fetch-v1"

pytestmark = pytest.mark.slow


@pytest.fixture(params=SIZES, ids=["desktop", "phone"])
def opened(request: pytest.FixtureRequest, browser: Browser) -> Iterator[Page]:
    """The page as it opens, without a network."""
    context = browser.new_context(viewport=request.param, offline=True)
    page = context.new_page()
    page.goto((SITE / "index.html").as_uri())
    page.locator("html[data-ready]").wait_for()
    yield page
    context.close()


def in_first_viewport(page: Page, text: str) -> bool:
    """Return whether a text is on the first screen, none of it cut off."""
    found: bool = page.evaluate(
        r"""(wanted) => [...document.querySelectorAll("h2, h3, p, dl > div")].some((one) => {
            const text = one.textContent.replace(/\s+/g, " "), box = one.getBoundingClientRect();
            return text.includes(wanted) && one.checkVisibility() && box.top >= 0 && box.left >= 0
                && box.bottom <= window.innerHeight && box.right <= window.innerWidth;
        })""",
        text,
    )
    return found


def tabs_of(page: Page) -> list[Locator]:
    """Return the tabs of a page, which has one for each scenario at least."""
    tabs = page.locator(".tabs a").all()
    scenarios = json.loads((SITE / "board.json").read_text(encoding="utf-8"))["board"]["starts"]
    assert len(tabs) >= len(scenarios) > 0
    return tabs


def rows() -> list[dict[str, Any]]:
    board = json.loads((SITE / "board.json").read_text(encoding="utf-8"))["board"]
    return [row for row in board["rows"] if row["scenario"] == MAIN]


def test_the_first_screen_says_what_a_researcher_asks_first(opened: Page) -> None:
    free = [row for row in rows() if row["division"] == "prior-data-free"]
    best = max(free, key=lambda row: row["estimates"]["kept"][0])
    kept, cost = best["estimates"]["kept"][0], best["costs"]["relative_cost"]
    assert in_first_viewport(opened, best["method"])
    assert in_first_viewport(opened, f"it keeps the most ({kept:.2f})")
    assert in_first_viewport(opened, f"Its training takes {cost:.2f} times as long as sft's")
    ahead = [row["method"] for row in rows() if row["method"] != "sft" and row["estimates"]["gain"][1] > 0]
    for method in ahead[:3]:
        assert in_first_viewport(opened, method)
    assert in_first_viewport(opened, "above plain fine-tuning")
    assert opened.evaluate("document.querySelectorAll('*').length") <= 4000  # only the open part has elements
    assert (SITE / "index.html").stat().st_size < 3_000_000


def test_every_tab_fits_the_screen_and_axe_finds_nothing_serious(opened: Page) -> None:
    for place in tabs_of(opened):
        place.click()
        opened.wait_for_timeout(300)
        assert opened.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        found = Axe().run(opened).response["violations"]
        assert not [one["id"] for one in found if one["impact"] in ("serious", "critical")]
        # axe would look at all parts that were opened, again and again
        opened.evaluate("document.querySelector('.part:not([hidden])').remove()")


def test_a_seed_names_its_targets_in_their_order(opened: Page) -> None:
    record = json.loads((SITE.parent / "records" / "Fetch-v1" / "sft" / "seed-1.json").read_text())
    order = f"Targets 1 to 4 of this seed: {', '.join(record['scenario']['target'])}."
    opened.goto(f"{(SITE / 'index.html').as_uri()}#{MAIN}/sft")
    row = opened.locator("dialog[open]")
    row.get_by_role("button", name="seed 1", exact=True).click()
    expect(row).to_contain_text(order)
    row.get_by_role("button", name="mean").click()
    expect(row).not_to_contain_text("Targets 1 to 4 of this seed")


def test_forced_colours_show_the_open_tab_the_chosen_seed_and_the_frames(opened: Page) -> None:
    def style(chosen: str, name: str) -> str:
        found: str = opened.evaluate(
            "([chosen, name]) => getComputedStyle(document.querySelector(chosen))[name]", [chosen, name]
        )
        return found

    opened.emulate_media(forced_colors="active")
    current, other = (
        style(f".tabs a{kind}", "borderBottomColor") for kind in ("[aria-current]", ":not([aria-current])")
    )
    assert current != other
    opened.goto(f"{(SITE / 'index.html').as_uri()}#{MAIN}/sft")
    opened.locator("dialog[open] .matrix").wait_for()
    pressed, free = (style(f".seeds [aria-pressed={kind}]", "backgroundColor") for kind in ("true", "false"))
    assert pressed != free
    assert style(".matrix .learned", "outlineStyle") == "solid"
