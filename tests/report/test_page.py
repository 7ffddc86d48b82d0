"""The page: everything inside one file, every text escaped, whatever runs and names hold."""

from __future__ import annotations

import base64
import hashlib
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from apex_lab.report import contents
from apex_lab.report.contents import Configuration, Pictures, Seed
from apex_lab.report.page import CONTENTS, Made, Missing, Report, render
from apex_lab.report.pictures import Picture
from apex_lab.report.tables import BlockView, CellView, RowView, TableView
from apex_lab.runs.state import RunState, State

NASTY = """</script><script>alert('"1"')</script><img src=x onerror=alert(2)>{{ 7*7 }}"""
EMPTY = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}
EMPTY |= {"path", "rect", "line", "circle"}  # the page closes these with />


class Parsed(HTMLParser):
    """Elements and text of a page; fails where an element is not closed in its place."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len({name for name, _ in attrs}) == len(attrs), tag
        self.found.append((tag, dict(attrs)))
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "script"):
            self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.found if name == tag]


def seed(number: int, state: State, folder: Path, reason: str | None = None, **record: object) -> Seed:
    return Seed(number, RunState(folder / f"seed_{number}", state, reason, dict(record)), f"python {NASTY}")


@pytest.fixture
def report(tmp_path: Path) -> Report:
    """Two configurations, one with a table of curves, and text that would be markup in every place that has text."""
    seeds = (
        seed(0, "finished", tmp_path, versions={NASTY: NASTY}, hardware={"cpu": NASTY}, commit=NASTY, seconds=3600),
        seed(1, "failed", tmp_path, NASTY, steps=12, data_fingerprint=NASTY),
        seed(2, "waiting", tmp_path),
    )
    for one in seeds[:2]:
        one.state.folder.mkdir()
        (one.state.folder / "curves.csv").write_text("step,train/loss,val/ari_fg\n1,2,0.5\n2,1,0.6\n")
    choices = {"data": NASTY, "scale": NASTY}
    rows = [
        Configuration(NASTY, NASTY, NASTY, choices, {"a": NASTY, NASTY: 1}, seeds),
        Configuration("b", "B", "B", choices, {"a": 2}, seeds[2:]),
    ]
    panels, _ = contents.panels(rows)
    settings, _ = contents.settings(rows)
    row = RowView(NASTY, [CellView(NASTY, True, NASTY)], "2 of 4")
    table = TableView("1", NASTY, [NASTY], [BlockView(NASTY, [row])], [NASTY], NASTY)
    strip = Picture("data:image/png;base64,AAAA", 10, 20)
    return Report(
        title=NASTY,
        made=Made(NASTY, NASTY, NASTY, NASTY, NASTY, NASTY, NASTY),
        configurations=rows,
        tables=[table],
        panels=panels,
        pictures=[Pictures(NASTY, 0, strip, Picture("data:video/mp4;base64,AAAA", None, None))],
        settings=settings,
        missing=[Missing(NASTY, NASTY, NASTY)],
        limit=NASTY,
        warnings=[NASTY],
        curve_remarks=[NASTY],
        setting_remarks=[NASTY],
        left_out=[NASTY],
    )


def test_text_of_runs_stays_text(report: Report) -> None:
    page = render(report)
    parsed = Parsed(page)
    assert len(parsed.all("script")) == 1
    assert "alert(" not in page.split("<script>")[-1]
    assert [one for one in parsed.all("img") if not str(one["src"]).startswith("data:image/png;base64,")] == []
    assert not any(name.startswith("on") for _, attributes in parsed.found for name in attributes)
    assert "49" not in page.split("<main")[0].split("</style>")[1]
    assert parsed.text.count(NASTY) > 15


def test_a_browser_is_told_to_run_this_script_alone_and_to_load_nothing(report: Report) -> None:
    page = render(report)
    script = re.search(r"<script>(.*?)</script>", page, re.DOTALL)
    assert script is not None
    digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    policy = Parsed(page).all("meta")[1]["content"]
    assert policy is not None
    assert f"script-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none';")


def test_nothing_outside_the_file_is_named(report: Report) -> None:
    parsed = Parsed(render(report))
    addresses = [str(a[name]) for _, a in parsed.found for name in ("src", "href", "poster", "action") if name in a]
    assert addresses
    assert [one for one in addresses if not one.startswith(("data:", "#"))] == []
    assert "url(" not in re.sub(r"url\(#clip-[\d-]+\)", "", render(report))


def test_every_section_is_in_the_table_of_contents_and_named_once(report: Report) -> None:
    parsed = Parsed(render(report))
    ids = [str(attributes["id"]) for _, attributes in parsed.found if "id" in attributes]
    assert len(set(ids)) == len(ids)
    assert [a["href"] for a in parsed.all("a")[1:]] == [f"#{name}" for name, _ in CONTENTS]
    assert [section["id"] for section in parsed.all("section")] == [name for name, _ in CONTENTS]
    labels = [a[name] for _, a in parsed.found for name in ("aria-labelledby", "aria-describedby") if name in a]
    assert set(labels) <= set(ids)


def test_tables_have_headers_with_a_scope_and_pictures_have_words(report: Report) -> None:
    parsed = Parsed(render(report))
    assert {header.get("scope") for header in parsed.all("th")} == {"col", "row", "rowgroup"}
    assert all(image["alt"] for image in parsed.all("img"))
    assert all(drawing.get("aria-label") or drawing.get("aria-hidden") for drawing in parsed.all("svg"))
    assert all(movie["aria-label"] for movie in parsed.all("video"))


def test_numbers_of_the_overview(report: Report) -> None:
    text = re.sub(r"\s+", " ", Parsed(render(report)).text)
    assert "4runs in 2 configurations 1finished 2waiting 1failed 1.0hours of training" in text
    assert "failed at step 12" in text


def test_what_is_too_much_is_left_out_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = []
    for name in "ABC":
        seeds = tuple(
            seed(number, state, tmp_path / name) for number, state in enumerate(("waiting", "failed", "lost"))
        )
        for one in seeds[1:]:
            one.state.folder.mkdir(parents=True)
            (one.state.folder / "curves.csv").write_text("step,train/loss\n1,2\n2,1\n")
        rows.append(Configuration(name, name, name, {}, {"a": 1}, seeds))
    monkeypatch.setattr(contents, "CURVES", 2)
    monkeypatch.setattr(contents, "CURVE_SEEDS", 1)
    monkeypatch.setattr(contents, "SETTINGS", 1)
    monkeypatch.setattr(contents, "COLORS", 1)
    panels, remarks = contents.panels(rows)
    assert [panel.legend for panel in panels] == [[("A", 0)], [("B", 0)]]
    assert [list(panel.charts[0].lines[0].thin) for panel in panels] == [[1], [1]]
    assert remarks == [
        "Curves of the first 2 of 3 configurations; not of C.",
        "Curves, their means and bands are of the first 1 seeds of each configuration.",
    ]
    assert contents.settings(rows)[1] == ["Not printed, for there are more than 1: B, C."]


def test_an_empty_report_says_so() -> None:
    made = Made("2026-01-01", "a", "b", "c", "d", "0.1", None)
    page = render(Report("Report", made, [], [], [], [], [], [], "limit"))
    text = Parsed(page).text
    for sentence in ("None: no run failed", "Nothing: every run", "No run has curves", "No finished run has pictures"):
        assert sentence in text


def luminance(color: str) -> float:
    channels = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
def test_colors_can_be_told_from_the_ground(theme: int) -> None:
    """WCAG 2.2: 4.5 for text, 3 for lines."""
    style = (Path(contents.__file__).parent / "page" / "style.css").read_text()
    block = re.findall(r":root \{(.*?)\}", style, re.DOTALL)[theme]
    color = dict(re.findall(r"--(\w+): (#[0-9a-f]{6})", block))
    for ground in ("paper", "ground"):
        for text in ("ink", "soft", "link", "good", "bad", "wait"):
            assert contrast(color[text], color[ground]) >= 4.5, (text, ground)
    assert contrast(color["ink"], color["mark"]) >= 4.5
    for number in range(contents.COLORS):
        assert contrast(color[f"c{number}"], color["paper"]) >= 3, number
