"""The page on a phone: the whole table, a shadow where it goes on, and pictures as wide as the screen."""

import io
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Locator, Page

from clbench.base.entry_points import resolve

make_page = resolve("clbench.leaderboard.views.page:page")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")

pytestmark = pytest.mark.slow


@pytest.fixture
def phone(even_board: Callable[..., Path], browser: Browser) -> Iterator[Page]:
    """A phone with the page of three methods and their ladder."""
    for method in ("sft", "finch", "lora"):
        for factor in (0.1, 1.0):
            even_board(method, 0, 0.4, "ladder", step_factor=factor)
        records = even_board(method, 0, 0.2)
    path = records.parent / "index.html"
    path.write_text(make_page(compute_board(records), {}), encoding="utf-8")
    page = browser.new_page(viewport={"width": 390, "height": 420})
    page.goto(path.as_uri())
    page.locator("html[data-ready]").wait_for(timeout=300_000)
    yield page
    page.close()


def darkest(region: Locator) -> int:
    """Return the darkest grey of the last two pixels of a line of a table that has no text there."""
    picture = Image.open(io.BytesIO(region.screenshot())).convert("L")
    head = region.locator("thead").bounding_box()
    assert head is not None
    return int(np.min(np.asarray(picture)[round(head["height"]) + 8, -2:]))


def test_a_table_is_whole_and_a_shadow_says_that_columns_go_on(phone: Page) -> None:
    region = phone.locator(".board-region")
    assert region.evaluate("one => one.scrollHeight - one.clientHeight") == 0
    assert darkest(region) < 230
    region.evaluate("one => { one.scrollLeft = one.scrollWidth; }")
    assert darkest(region) == 255
    phone.set_viewport_size({"width": 1400, "height": 420})
    assert darkest(region) == 255


@pytest.mark.parametrize("width", [390, 330])
def test_a_frontier_is_as_wide_as_the_screen_and_keeps_its_shape(width: int, phone: Page) -> None:
    phone.set_viewport_size({"width": width, "height": 844})
    picture = phone.locator("figure[data-frontier] svg")
    picture.wait_for(timeout=300_000)
    box, shape = picture.bounding_box(), picture.evaluate("one => one.getAttribute('viewBox')").split()
    assert box is not None
    assert width - 50 <= box["width"] <= width - 32
    assert box["height"] / box["width"] == pytest.approx(float(shape[3]) / float(shape[2]), rel=0.01)
