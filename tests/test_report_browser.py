"""The report in a real browser: figures are drawn, tables sort, the slider moves, nothing is off the screen."""

import browser
import pytest
from made_results import results_of
from test_report import SETTINGS, hostile

from filtergym.reports.pages.html_report import report_html

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(browser.missing()), reason=browser.missing())]
FIGURES = ["ranking", "rmse", "exceeded", "difference", "consistency", "steering", "track", "worst"]
WAIT = 60.0
"""Seconds that suffice on any machine."""


@pytest.fixture(scope="module")
def results():
    target = ["imm", "adaptive-rearm-tuned", "kalman-imm-tuned", "ppo", "known-turn", "known-input-bound"]
    pilot = ["kalman", "innovation-adaptive-tuned", "gust-imm-tuned", "ppo", "matched", "known-noise-bound"]
    return [
        results_of("filtergym/ManeuveringTarget-v0", target, None, 10),
        results_of("filtergym/ManeuveringTarget-v0", target, "paper", 10),
        results_of("filtergym/UavAutopilot-v0", pilot, None, 4, horizon=150),
    ]


@pytest.fixture(scope="module")
def page(results, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(report_html(results, SETTINGS), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def wide(page):
    with browser.opened(page, 1400, height=1400) as driver:
        yield opened_whole(driver)


@pytest.fixture(scope="module")
def narrow(page):
    with browser.opened(page, 400) as driver:
        yield opened_whole(driver)


def opened_whole(driver):
    """Open every scenario and wait until all of it is drawn."""
    from selenium.webdriver.support.ui import WebDriverWait

    driver.execute_script(
        "for (const d of document.querySelectorAll('details')) d.open = true;"
        "for (const f of document.querySelectorAll('figure[data-kind=dots]')) f.scrollIntoView();"
    )
    WebDriverWait(driver, WAIT).until(
        lambda d: d.execute_script(
            "return [...document.querySelectorAll('details.cell, figure[data-kind=dots]')]"
            ".every(x => x.dataset.drawn === 'done')"
        )
    )
    return driver


def errors(driver):
    return [entry for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]


def plots(driver, figure):
    """Of every plot in a figure: its traces, and the numbers of points in each."""
    return driver.execute_script(
        "return [...arguments[0].querySelectorAll('.js-plotly-plot')].map(p => p.data.map(t => t.x.length))",
        figure,
    )


@pytest.mark.parametrize("screen", ["wide", "narrow"])
def test_every_figure_is_drawn_and_nothing_complains(screen, request):
    driver = request.getfixturevalue(screen)
    for details in driver.find_elements("css selector", "details.cell"):
        kinds = []
        for figure in details.find_elements("css selector", "figure"):
            kinds.append(figure.get_attribute("data-kind"))
            assert "cannot be drawn" not in figure.text
            for traces in plots(driver, figure):
                assert traces
                assert max(traces) > 0
        assert kinds == FIGURES
    assert driver.execute_script("return document.querySelectorAll('.plot .main-svg').length") >= 3 * len(
        FIGURES
    )
    assert errors(driver) == []
    # It needs nothing from anywhere.
    assert driver.execute_script("return performance.getEntriesByType('resource').length") == 0


def test_nothing_is_off_a_narrow_screen(narrow):
    driver = narrow
    wide, seen = driver.execute_script(
        "const s = document.scrollingElement; return [s.scrollWidth, s.clientWidth]"
    )
    assert wide <= seen == 400
    beyond = driver.execute_script(
        "return [...document.querySelectorAll('h2, h3, p, li, figure, .plot, .main-svg, select, button, input')]"
        ".filter(x => !x.closest('.table, nav')).map(x => x.getBoundingClientRect().right)"
        ".filter(right => right > 400.5).length"
    )
    assert beyond == 0
    # No column is cut: a row of a wide table stands as lines.
    cut = driver.execute_script(
        "return [...document.querySelectorAll('.stacked :is(th, td)')].map(x => x.getBoundingClientRect().right)"
        ".filter(right => right > 400.5).length"
    )
    assert cut == 0
    # Whatever is wider scrolls inside itself.
    assert driver.execute_script(
        "return [...document.querySelectorAll('.table')].every(x => getComputedStyle(x).overflowX === 'auto')"
    )


def test_a_table_that_is_too_wide_has_a_hint(page):
    with browser.opened(page, 1000) as driver:
        opened_whole(driver)
        scrolls = driver.execute_async_script(
            "const done = arguments[0], tables = [...document.querySelectorAll('.table')];"
            "requestAnimationFrame(() => requestAnimationFrame(() => done("
            "tables.map(x => [x.scrollWidth > x.clientWidth + 1, x.classList.contains('scrolls')]))))"
        )
        assert all(wider == width for wider, width in scrolls)
        assert any(width for _, width in scrolls)


def test_tables_sort_by_number_and_by_name(wide):
    driver = wide
    table = driver.find_element("css selector", "table.sortable")

    def column(title):
        names = [head.text for head in table.find_elements("css selector", "thead th")]
        place = next(i for i, name in enumerate(names) if name.startswith(title))
        cells = driver.execute_script(
            "return [...arguments[0].tBodies[0].rows].map(r => r.cells[arguments[1]].dataset.sort ?? null)",
            table,
            place,
        )
        return table.find_elements("css selector", "thead button")[place], cells

    for title, parsed in (("RMSE position", float), ("competitor", str), ("ANEES", float)):
        button, _ = column(title)
        for order in (1, -1):
            driver.execute_script("arguments[0].click()", button)
            present = [parsed(x) for x in column(title)[1] if x is not None]
            assert present == sorted(present, reverse=order < 0)
            # What has none stands last both times.
            assert None not in column(title)[1][: len(present)]


def test_slider_moves_the_track_and_choices_change_the_figure(wide):
    driver = wide
    for details in driver.find_elements("css selector", "details.cell"):
        figure = details.find_element("css selector", "figure[data-kind=track]")
        slider = figure.find_element("css selector", "input[type=range]")
        shown = []
        for place in (3, 60):
            driver.execute_async_script(
                "const [slider, place, done] = arguments; slider.value = place;"
                "slider.dispatchEvent(new Event('input'));"
                "requestAnimationFrame(() => requestAnimationFrame(done))",
                slider, place,
            )  # fmt: skip
            shown.append((figure.find_element("css selector", "output").text, plots(driver, figure)))
        (early, few), (late, many) = shown
        assert early != late
        assert min(few[0]) == 4
        assert min(many[0]) == 61
    select = driver.find_element("css selector", "figure[data-kind=rmse] select")
    title = "return document.querySelector('figure[data-kind=rmse] .js-plotly-plot').layout.yaxis.title.text"
    before = driver.execute_script(title)
    driver.execute_script("arguments[0].value = 1; arguments[0].dispatchEvent(new Event('change'))", select)
    assert (before, driver.execute_script(title)) == ("RMSE of position, m", "RMSE of velocity, m/s")


def test_light_and_dark(wide):
    colour = "return getComputedStyle(document.body).backgroundColor"
    line = "return document.querySelector('figure[data-kind=rmse] .js-plotly-plot').layout.font.color"

    def shown():
        return wide.execute_script(colour), wide.execute_script(line)

    light = shown()
    wide.find_element("id", "theme").click()
    dark = shown()
    assert dark[0] != light[0]
    assert dark[1] != light[1]
    wide.find_element("id", "theme").click()
    assert shown() == light
    # Who asks for dark everywhere gets it here.
    wide.execute_script("delete document.documentElement.dataset.theme")
    browser.emulate_scheme(wide, dark=True)
    assert wide.execute_script(colour) == dark[0]
    browser.emulate_scheme(wide, dark=False)


def test_a_hostile_file_runs_nothing(results, tmp_path):
    page = tmp_path / "report.html"
    page.write_text(report_html([hostile(results[0])], SETTINGS), encoding="utf-8")
    with browser.opened(page, 1400) as driver:
        opened_whole(driver)
        for select in driver.find_elements("css selector", "select"):
            driver.execute_script(
                "arguments[0].value = 1; arguments[0].dispatchEvent(new Event('change'))", select
            )
        assert driver.execute_script("return window.stolen === undefined")
        assert (
            driver.execute_script(
                "return document.querySelectorAll('main img, main script[src], iframe').length"
            )
            == 0
        )
        # Not even the page's policy had anything to refuse.
        assert errors(driver) == []
        # The content of the file is shown as text, in tables and in figures.
        assert "</script><script>" in driver.find_element("css selector", "table.sortable").text
        assert driver.execute_script(
            "return document.querySelector('figure[data-kind=ranking] .plot').textContent.includes('<img')"
        )
