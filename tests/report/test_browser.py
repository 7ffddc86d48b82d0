"""The report in a real Chromium: opened from disk, in both themes, at the width of a desktop and of a phone."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from apex_lab.report import asked
from apex_lab.runs.listed import listed
from tests.report.runs_made import made, pictures

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
SIZES = {"desktop": (1280, 900), "phone": (390, 844)}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with sync_api.sync_playwright() as play:
        own = play.chromium.executable_path
        found = next(filter(None, map(shutil.which, NAMES)), own if Path(own).is_file() else None)
        if found is None:
            pytest.skip(f"there is no Chromium: none of {', '.join(NAMES)} is on the PATH, and playwright has none")
        browser = play.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of the ablations with finished, failed and missing runs."""
    outputs = tmp_path_factory.mktemp("outputs")
    words = ["+sweep=ablations", "scale=smoke", f"paths.outputs={outputs}"]
    for number, job in enumerate(listed(words)):
        if number == 3:
            made(job, "failed", '<b>loss</b> is not finite at step 130: "lower" optimizer.lr & start again.')
        elif number != 7:
            made(job)
            if job.seed == 0 and number < 12:
                pictures(job.folder)
    return asked.write([*words, f"folder={outputs / 'report'}"])


@pytest.fixture(params=[(size, theme) for size in SIZES for theme in ("light", "dark")], ids="-".join)
def page(chromium: Any, page_file: Path, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The opened page; fails at its end where the browser has complained or looked outside the file."""
    size, theme = request.param
    width, height = SIZES[size]
    context = chromium.new_context(
        viewport={"width": width, "height": height}, color_scheme=theme, offline=True, has_touch=size == "phone"
    )
    page = context.new_page()
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda dialog: complaints.append(dialog.message))
    page.on("request", lambda asked: complaints.append(asked.url[:80]) if not _inside(asked.url, page_file) else None)
    page.goto(page_file.as_uri())
    page.theme, page.size = theme, size
    yield page
    assert complaints == []
    context.close()


def _inside(address: str, file: Path) -> bool:
    return address.startswith("data:") or address == file.as_uri()


def test_the_page_shows_everything_and_never_scrolls_sideways(page: Any) -> None:
    page.mouse.wheel(0, 100_000)
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[page.size][0]
    assert page.locator("#tables table").count() >= 1
    assert "APEX" in page.locator("#tables table").first.inner_text()
    assert page.locator("#overview tbody tr").count() == 10
    assert page.locator(".chart svg").count() >= 4
    assert page.locator(".chart .mean").first.is_visible()
    assert page.locator("#pictures img").count() == 3
    assert '<b>loss</b> is not finite at step 130: "lower"' in page.locator("#failures").inner_text()
    assert "seed=3" in page.locator("#missing").inner_text()
    assert all(box["width"] <= SIZES[page.size][0] for box in map(_box, page.locator("section").all()))


def _box(element: Any) -> dict[str, float]:
    return element.bounding_box()


def test_every_letter_can_be_read(page: Any) -> None:
    """Also those of the charts, which are drawn to the size of the window."""
    sizes = page.evaluate(
        "[...document.querySelectorAll('p, td, th, li, dd, code, summary, .chart text')]"
        ".filter(e => e.checkVisibility())"
        ".map(e => parseFloat(getComputedStyle(e).fontSize) * (e.closest('svg')?.getScreenCTM().a ?? 1))"
    )
    assert min(sizes) >= 11


def test_the_theme_is_that_of_the_system(page: Any) -> None:
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("L"))
    assert (picture.mean() > 128) == (page.theme == "light")
    assert picture.std() > 5


def until(page: Any, expression: str) -> None:
    """Waits; playwright's own waiting evaluates text as code, which the page forbids."""
    for _ in range(200):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"still not: {expression}")


def test_pictures_load_and_movies_play(page: Any) -> None:
    image = page.locator("#pictures img").first
    image.scroll_into_view_if_needed()
    until(page, "document.querySelector('#pictures img').naturalWidth == 128")
    movie = page.locator("#pictures video").first
    movie.scroll_into_view_if_needed()
    if not page.evaluate("document.createElement('video').canPlayType('video/mp4; codecs=\"avc1.42E01E\"')"):
        pytest.skip("this Chromium was built without H.264")
    until(page, "document.querySelector('video').readyState >= 1")
    movie.evaluate("movie => movie.play()")
    until(page, "document.querySelector('video').currentTime > 0")
    assert movie.evaluate("movie => [movie.muted, movie.loop, movie.videoWidth]") == [True, True, 128]


def test_the_pointer_reads_values_and_the_legend_hides_them(page: Any) -> None:
    chart = page.locator(".chart svg").first
    chart.scroll_into_view_if_needed()
    box = _box(chart)
    page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.4 * box["height"])
    tip = page.locator(".tip").first
    assert tip.is_visible()
    assert "APEX: 0." in tip.inner_text()
    assert "±" in tip.inner_text()
    button = page.locator(".legend button").first
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    assert not page.locator(".series.k0 .mean").first.is_visible()
    button.click()
    assert page.locator(".series.k0 .mean").first.is_visible()


def test_the_contents_lead_to_their_sections(page: Any) -> None:
    for link in page.locator("nav a").all():
        link.click()
        anchor = page.evaluate("location.hash")
        assert page.locator(anchor).count() == 1
        top = page.evaluate(f"document.querySelector('{anchor}').getBoundingClientRect().top")
        assert -1 <= top < SIZES[page.size][1]


def test_paper_shows_what_is_folded(page: Any) -> None:
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.locator("details:not([open])").count() == 0
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.locator("details[open]").count() == 0
    assert len(page.pdf()) > 10_000
