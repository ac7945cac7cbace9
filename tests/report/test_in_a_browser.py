"""The report in a browser: pictures wipe and enlarge by mouse, finger and keys, and phones can read it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from browser import Page, browser, require_browser
from gs2d.report.write import write_report
from report_runs import fabricate

AT = "parseFloat(document.querySelector('.wipe .both').style.getPropertyValue('--at'))"
LARGE = "document.querySelector('dialog.large').open"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    require_browser()
    run = fabricate(tmp_path_factory.mktemp("report") / "run")
    write_report(run)
    with browser() as tab:
        tab.size(1600, 1000)
        tab.open(f"file://{run}/report.html")
        yield tab
        assert tab.errors == []


def test_the_line_between_photograph_and_rendering_follows_mouse_and_arrow_keys(page: Page) -> None:
    left, width = page.ask("(() => {const b = document.querySelector('.wipe .both').getBoundingClientRect();"
                           "return [b.x, b.width]})()")  # fmt: skip
    _, y = page.middle(".wipe .both")
    page.drag((left + 0.5 * width, y), (left + 0.2 * width, y))
    assert page.ask(AT) == pytest.approx(20, abs=1)
    page.mouse("mouseMoved", left + 0.9 * width, y, buttons=0, button="none")
    assert page.ask(AT) == pytest.approx(20, abs=1)  # only while it is held
    page.key("ArrowRight")
    page.key("ArrowRight")
    assert page.ask(AT) == pytest.approx(22, abs=1)
    both = page.ask("[...document.querySelectorAll('.wipe .both img')].slice(0, 2)"
                    ".map((i) => getComputedStyle(i).clipPath)")  # fmt: skip
    assert "78%" in both[0].replace("calc(100% - 22%)", "78%")  # the photograph ends at the line
    assert both[1] == "none"


def test_pictures_enlarge_in_all_their_pixels_and_step_by_keys(page: Page) -> None:
    page.click(".hero.first .hero button.zoom")
    assert page.ask(LARGE)
    first = page.ask("document.querySelector('dialog p').textContent")
    assert first.startswith("Normal, refine of test/r_0")
    # not the JPEG in the report: the file in the run's folder
    page.until("document.querySelector('dialog .stage img').src.endsWith('renders/refine/test__r_0.normal.png')")
    page.key("ArrowRight")
    assert page.ask("document.querySelector('dialog p').textContent") != first
    page.key("Escape")
    assert not page.ask(LARGE)
    page.ask("document.querySelector('.hero.first .hero button.zoom').focus()")
    page.key("Enter")
    assert page.ask(LARGE)
    page.click("dialog .close")
    assert not page.ask(LARGE)


def test_a_phone_reads_it_without_moving_sideways_and_wipes_by_finger(page: Page) -> None:
    page.size(375, 812, phone=True)
    try:
        assert page.ask("document.documentElement.scrollWidth") <= 375
        x, y = page.middle(".wipe .both")
        page.fingers(((x, y), (x + 100, y)))
        assert page.ask(AT) == pytest.approx(50 + 100 * 100 / 343, abs=2)
        small = page.ask("[...document.querySelectorAll('main button, main summary')].filter((e) => "
                         "!e.textContent.trim() && !e.getAttribute('aria-label')).length")  # fmt: skip
        assert small == 0  # everything that can be pressed has a name
    finally:
        page.size(1600, 1000)
