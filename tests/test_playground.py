"""The playground of the first page: what it shows is what the filters of Python say of the same measurements.

Of the modules with wasmtime, of the page in a browser; each is skipped where it is not installed.
"""

import csv
import importlib.util
import io
import shutil
from pathlib import Path

import browser
import numpy as np
import pytest
from playground import ENVIRONMENT, FILTERS, compile_filter, has_compiler, module_file, page_script
from record_directives import PLAYGROUND

import filtergym

STATIC = Path(__file__).parent.parent / "docs" / "_static"
WAIT = 60.0
"""Seconds that suffice on any machine."""
WIDTH = 16_000.0
"""Of the map, m."""
in_browser = pytest.mark.skipif(bool(browser.missing()), reason=browser.missing())
with_wasmtime = pytest.mark.skipif(
    importlib.util.find_spec("wasmtime") is None, reason="wasmtime is not installed"
)


# --- the same measurements in Python


def replay(name, plots):
    """Estimates of a filter, ``(plots, 4)`` and ``(plots, 4, 4)``, after a track was started from the first two."""
    filter = filtergym.online(ENVIRONMENT, name)
    filter.start_from(*plots[:2])
    found = [filter.update(**plot) for plot in plots[2:]]
    return np.array([estimate.mean for estimate in found]), np.array([e.covariance for e in found])


def assert_equal_up_to_rounding(mean, covariance, name, plots):
    """Compare with Python, in standard deviations.

    The tolerance is how far the filter itself moves when its measurements are a hundred roundings off. Weights follow
    from innovations, so the conditioning depends on the track, and no matrix has it as its condition number.
    """
    expected, P = replay(name, plots)
    sigma = np.sqrt(np.einsum("kii->ki", P))
    rng = np.random.default_rng(0)
    off = 1.0 + 100.0 * np.finfo(float).eps * rng.choice([-1.0, 1.0], (len(plots), 2))
    moved = [
        {**plot, "x": (plot["x"] or np.nan) * a, "y": (plot["y"] or np.nan) * b}
        for plot, (a, b) in zip(plots, off, strict=True)
    ]
    other, Q = replay(name, moved)
    tolerance = (np.abs(other - expected) / sigma).max()
    assert 0.0 < tolerance < 1e-3  # else the comparison shows nothing
    assert (np.abs(mean - expected) / sigma).max() < tolerance
    scale = sigma[:, :, None] * sigma[:, None, :]
    assert (np.abs(covariance - P) / scale).max() < max((np.abs(Q - P) / scale).max(), 1e-11)


# --- modules


def flown():
    """A target that turns, seen through noise, with scans that miss it and come at irregular times."""
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(2.0, 9.0, 300))
    heading = np.cumsum(np.where(np.arange(300) // 40 % 2, 0.1, 0.0))
    step = 150.0 * np.gradient(time) * np.array([np.sin(heading), np.cos(heading)])
    x, y = np.cumsum(step, axis=1) + rng.normal(0.0, 100.0, (2, 300))
    missed = rng.random(300) < 0.15
    missed[:3] = False
    x[missed] = y[missed] = np.nan
    names = ("time", "x", "y", "sigma_x", "sigma_y")
    return [
        dict(zip(names, row, strict=True))
        for row in np.column_stack([time, x, y, np.full((300, 2), 100.0)]).tolist()
    ]


def run_module(module, plots):
    """Run a module over plots, as the page does."""
    import wasmtime

    store = wasmtime.Store()
    own = wasmtime.Instance(store, wasmtime.Module(store.engine, module), []).exports(store)
    own["_initialize"](store)

    def row(name, count):
        place = own[name](store)
        return np.frombuffer(own["memory"].get_buffer_ptr(store), np.float64, count, place)

    filter = filtergym.online(ENVIRONMENT, "imm")
    started = filter.input.start_from(*plots[:2])
    row("initial", 20)[:] = np.concatenate([started["mean"].ravel(), started["covariance"].ravel()])
    own["start"](store)
    found, last, seen = [], plots[1]["time"], plots[1]["time"]
    for scan, plot in enumerate(plots[2:], 1):
        there = np.isfinite(plot["x"])
        position = [plot["x"], plot["y"]] if there else [0.0, 0.0]
        variance = [plot["sigma_x"] ** 2, plot["sigma_y"] ** 2]
        row("measurement", 8)[:] = [
            scan,
            *position,
            *variance,
            there,
            plot["time"] - last,
            plot["time"] - seen,
        ]
        assert own["update"](store) == (0 if there else 1)
        found.append(row("estimate", 23).copy())
        last = plot["time"]
        seen = last if there else seen
    return np.array(found)


@with_wasmtime
@pytest.mark.parametrize("name", FILTERS)
def test_a_module_is_the_filter_that_is_judged(name):
    plots = flown()
    found = run_module(module_file(name).read_bytes(), plots)
    assert_equal_up_to_rounding(found[:, :4], found[:, 4:20].reshape(-1, 4, 4), name, plots)


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="ziglang is not installed")
@pytest.mark.parametrize("name", FILTERS)
def test_committed_modules_are_those_of_the_exports(name):
    """Byte for byte; another version of the compiler may order its code in another way."""
    module, committed = compile_filter(name), module_file(name).read_bytes()
    if module != committed:
        pytest.importorskip(
            "wasmtime", reason="modules differ, and wasmtime is not installed to compare them"
        )
        ours, theirs = run_module(module, flown()), run_module(committed, flown())
        np.testing.assert_allclose(ours[:, :20], theirs[:, :20], rtol=1e-9, atol=1e-9)


# --- the page


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page with nothing but the playground."""
    folder = tmp_path_factory.mktemp("playground")
    for name in ("playground.js", "playground.css"):
        shutil.copy(STATIC / name, folder)
    modules = {name: module_file(name).read_bytes() for name in FILTERS}
    (folder / "playground_filters.js").write_text(page_script(modules), encoding="utf-8")
    body = PLAYGROUND.format(static=".") + '<p id="still">picture</p></noscript></div>'
    (folder / "index.html").write_text(f"<!doctype html><body>{body}</body>", encoding="utf-8")
    return folder / "index.html"


@pytest.fixture
def driver(page):
    with browser.opened(page, 1000, height=1200) as driver:
        wait(driver, "return document.getElementById('playground').dataset.state === 'ready'")
        yield driver
        assert [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"] == []


def wait(driver, script):
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(driver, WAIT).until(lambda d: d.execute_script(script))


def set_slider(driver, name, value):
    driver.execute_script(
        "const s = document.querySelector(`#playground input[name=${arguments[0]}]`);"
        "s.value = arguments[1]; s.dispatchEvent(new Event('input'))",
        name,
        value,
    )


def shown_steps(driver):
    """Plots as ``update`` takes them, from the two that start the track on; and what the page makes of the others."""
    steps = driver.execute_script(
        "return playground.track.steps.map((s) => ({...s, x: s.seen ? s.x : null, y: s.seen ? s.y : null}))"
    )
    first = next(i for i, step in enumerate(steps) if "start" in step)
    before = max(i for i in range(first) if steps[i]["seen"])
    names = ("time", "x", "y", "sigma_x", "sigma_y")
    kept = [steps[before], *steps[first:]]
    return [{name: step[name] for name in names} for step in kept], kept[2:]


def assert_shows_what_python_computes(driver):
    plots, shown = shown_steps(driver)
    for name in FILTERS:
        own = [step["estimates"][name] for step in shown]
        assert all(estimate["taken"] for estimate in own)
        mean, covariance = (np.array([e[part] for e in own]) for part in ("mean", "covariance"))
        assert_equal_up_to_rounding(mean, covariance, name, plots)
        weights = np.array([estimate["weights"] for estimate in own])
        if len(FILTERS[name]) > 1:
            np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-9)
        assert np.ptp(weights, axis=0).max() > 0.01  # they move
    return shown


DROP = """
const held = new DataTransfer();
held.items.add(new File([arguments[0]], 'mine.csv', {type: 'text/csv'}));
document.querySelector('#playground .map').dispatchEvent(
  new DragEvent('drop', {dataTransfer: held, bubbles: true, cancelable: true}));
"""
STATUS = "document.querySelector('#playground [role=status]').textContent"


@pytest.mark.slow
@in_browser
def test_a_table_is_run_as_python_runs_it(driver):
    plots = flown()
    table = io.StringIO()
    rows = csv.DictWriter(table, plots[0])
    rows.writeheader()
    rows.writerows({k: "" if v != v else v for k, v in plot.items()} for plot in plots)
    driver.execute_script(DROP, table.getvalue())
    wait(driver, f"return {STATUS}.startsWith('mine.csv: 300 rows')")
    assert len(assert_shows_what_python_computes(driver)) == 298
    # Deviations that the table does not state are those of the slider.
    set_slider(driver, "noise", 200)
    bare = "\n".join(",".join(line.split(",")[:3]) for line in table.getvalue().splitlines())
    driver.execute_script(DROP, bare)
    wait(driver, "return playground.track.steps[0].sigma_x === 200")
    assert_shows_what_python_computes(driver)
    for broken, complaint in (
        ("time,x\n1,2", "y not found"),
        ("time,x,y\n1,2,3\n1,2,3\n2,3,4", "row 2"),
        ("time,x,y\n1,2,3\n2,3,4", "three plots"),
    ):
        driver.execute_script(DROP, broken)
        wait(driver, f"return {STATUS}.includes('{complaint}')")


@pytest.mark.slow
@in_browser
def test_a_picture_stands_where_scripts_are_off(page):
    with browser.opened(page, 400) as driver:
        assert driver.find_elements("css selector", "#still") == []
        driver.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
        driver.get(page.as_uri())
        assert driver.find_element("css selector", "#still").text == "picture"
        assert driver.find_elements("css selector", "#playground canvas") == []
