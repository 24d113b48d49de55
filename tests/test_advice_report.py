"""The page of an advice: what stands in it, what is drawn, and that nothing in it runs."""

import base64
import dataclasses
import gzip
import itertools
import json
import re
import subprocess
import sys

import browser
import numpy as np
import pytest

from filtergym.baselines import advice as advice_module
from filtergym.baselines.advice import FittedLog, advise
from filtergym.baselines.maneuvering_target.log_families import log_families
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.envs.logs.reading import read_recording
from filtergym.evaluation.running.metrics import chi_square_band
from filtergym.reports.tables.advice import advice_rows, further_sentences, verdict

pytest.importorskip("plotly")
pytest.importorskip("jinja2")

from filtergym.reports.pages.advice_report import advice_html
from filtergym.reports.tables.results import settings_of

PROBLEM = problem_of("filtergym/ManeuveringTarget-v0")
FAMILIES = ("constant-velocity", "constant-acceleration")
COUNT, FIRST_MISSED, LAST_MISSED = 160, 60, 70


@pytest.fixture(scope="module")
def advice(tmp_path_factory):
    """Of a target that turns now and then, with ten scans in a row without a row."""
    rng = np.random.default_rng(2)
    velocity = np.array([20.0, 5.0]) + np.cumsum(rng.normal(0.0, 1.5, (COUNT, 2)), axis=0)
    plots = np.cumsum(velocity, axis=0) + rng.normal(0.0, 5.0, (COUNT, 2))
    columns = np.column_stack([np.arange(COUNT), plots, np.full_like(plots, 5.0)])
    rows = np.delete(columns, slice(FIRST_MISSED, LAST_MISSED), axis=0)
    path = tmp_path_factory.mktemp("logs") / "log.csv"
    np.savetxt(path, rows, "%.6f", ",", header="time,x,y,sigma_x,sigma_y", comments="")
    shipped = {name: PROBLEM.competitor(name) for name in ("imm", "kalman-imm")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            advice_module, "families_of", lambda _, log: {n: log_families(log)[n] for n in FAMILIES}
        )
        return advise(FittedLog(PROBLEM, read_recording(path, PROBLEM.id)), shipped)


def page_of(advice):
    task = make_task(PROBLEM.task, advice.recording)
    return advice_html(
        advice, task, list(further_sentences(advice, [])), [], settings_of("filtergym advise log.csv")
    )


@pytest.fixture(scope="module")
def page(advice):
    return page_of(advice)


def figures(page):
    packed = re.search(r'class="data">([^<]*)<', page).group(1)
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def test_the_sentence_comes_first_and_tables_hold_what_was_fitted(advice, page):
    text = page.partition("<main>")[2]
    assert text.index(verdict(advice).split("[")[0]) < text.index("<table>")
    for name in advice.fits:
        assert name in text
    first, *others = [row.label for row in advice_rows(advice, [])]
    assert first == f"{advice.advised.name} (advised)"
    assert not any(label.endswith("(advised)") for label in others)
    assert {f"{name} (fitted)" for name in advice.fits} <= {*others}
    for sentence in further_sentences(advice, []):
        assert sentence.replace("'", "&#39;") in text
    assert "10 missed measurements: these have no row" in text
    assert "read 158 measurements after the start of 1 track, 10 of them missed" in text
    assert re.search(r"for fit, choice and judgement: \d+ / \d+ / \d+\.", text)
    assert "filtergym advise log.csv" in text


def test_pictures_are_of_the_replay_in_seconds(advice, page):
    """Scaled innovations have squares that sum to the NIS; digits are six."""
    data = figures(page)
    (episode,) = data["episodes"]
    seconds = np.array(episode["seconds"])
    np.testing.assert_allclose(seconds, np.arange(2, COUNT), rtol=1e-5)  # the track starts from two plots
    run = advice.replay().sel(policy=data["names"][0]).isel(episode=0)
    scaled = np.array(episode["innovations"], dtype=float)
    there = np.isfinite(scaled).all(axis=0)
    np.testing.assert_allclose((scaled**2).sum(axis=0)[there], run["nis"].values[there], rtol=1e-4)
    missed = (seconds >= FIRST_MISSED) & (seconds < LAST_MISSED)
    np.testing.assert_array_equal([x is None for x in episode["measured"][0]], missed)
    np.testing.assert_allclose(episode["estimates"][0], run["estimate"].values[:, :2].T, rtol=1e-5, atol=1e-5)


def test_outliers_are_drawn_where_they_were_measured(advice):
    outliers = np.zeros_like(advice.outliers)
    outliers[0, [5, 40]] = True
    (episode,) = figures(page_of(advice._replace(outliers=outliers)))["episodes"]
    assert episode["outlier_numbers"] == [6, 41]
    np.testing.assert_allclose(episode["outlier_seconds"], [7.0, 42.0], rtol=1e-5)
    for outlying, measured in zip(episode["outliers"], episode["measured"], strict=True):
        assert outlying == [measured[5], measured[40]]


def test_mean_nis_is_of_windows_and_its_band_that_of_their_degrees(advice, page):
    data = figures(page)
    nis = data["episodes"][0]["nis"][0]
    values = advice.replay()["nis"].sel(policy=data["names"][0]).values[0]
    there = np.flatnonzero(np.isfinite(values))
    assert nis["mean"][0] == pytest.approx(values[there[: nis["size"]]].sum() / (2.0 * nis["size"]), rel=1e-5)
    low, high = chi_square_band(np.array([2.0 * nis["size"]]))
    assert nis["low"][0] == pytest.approx(low[0] / (2.0 * nis["size"]), rel=1e-5)
    assert nis["high"][0] == pytest.approx(high[0] / (2.0 * nis["size"]), rel=1e-5)


def test_stretches_of_the_log_do_not_overlap(page):
    spans = sorted(figures(page)["episodes"][0]["spans"], key=lambda span: span[1])
    assert {role for role, *_ in spans} == {"fitted to", "chosen by", "judged by"}
    for (_, _, end), (_, begin, _) in itertools.pairwise(spans):
        assert end <= begin


def test_profiles_are_zero_at_the_best_value_and_pass_the_ends_of_the_interval(advice, page):
    intervals = advice.intervals
    for profile, (key, interval) in zip(figures(page)["profiles"], intervals.items(), strict=True):
        values, drops = np.array(profile["values"], dtype=float), np.array(profile["drops"], dtype=float)
        assert (np.diff(values) >= 0.0).all()
        assert drops.min() == pytest.approx(0.0, abs=1e-3)
        if not interval.open_high:
            high = 10.0**interval.high if key.startswith("log10_") else interval.high
            assert drops[values >= high * (1.0 - 1e-5)].max() > 1.9


def test_no_text_of_a_log_is_executed(advice):
    """Names and notes are text, and the page fetches nothing."""
    hostile = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
    recording = dataclasses.replace(advice.recording, name=hostile, notes=(hostile,), names=(hostile,))
    page = page_of(advice._replace(recording=recording))
    assert "alert(1)" not in re.sub(r"&lt;/script&gt;&lt;script&gt;alert\(1\)", "", page)
    assert "default-src 'none'" in page
    assert not re.search(r'(src|href)="(?!#)', page)


@pytest.mark.slow
@pytest.mark.skipif(bool(browser.missing()), reason=browser.missing())
def test_every_picture_is_drawn_and_nothing_complains(page, tmp_path):
    from selenium.webdriver.support.ui import WebDriverWait

    path = tmp_path / "advice.html"
    path.write_text(page, encoding="utf-8")
    drawn = "return document.body.dataset.drawn === 'done'"
    graphics = (
        "return [...document.querySelectorAll('figure')].map(f => f.querySelectorAll('.main-svg').length)"
    )
    with browser.opened(path, 400) as driver:
        WebDriverWait(driver, 60.0).until(lambda d: d.execute_script(drawn))
        counts = driver.execute_script(graphics)
        assert len(counts) == 4
        assert all(counts)
        assert not [entry for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
        assert driver.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")


def test_a_sensor_that_is_no_component_has_a_report_without_a_track(tmp_path):
    """A model of one's own, whose sensor ``float`` measures the component ``level``."""
    (tmp_path / "tank.py").write_text(
        "import filtergym\n"
        "from filtergym import Sensor\n"
        "Tank = filtergym.state_space('mine/Tank-v0', f=[[1, 1], [0, 1]], Q=[[0.01, 0], [0, 0.01]], mean=[1, 0],\n"
        "    sensors={'float': Sensor([[1, 0]], R=0.1)}, covariance=[[1, 0], [0, 1]], names=['level', 'rate'])\n"
    )
    noise = np.random.default_rng(0)
    level = 1.0 + np.cumsum(np.cumsum(noise.normal(0.0, 0.1, 200)))
    rows = [f"{k},{value}" for k, value in enumerate(level + noise.normal(0.0, 0.3, 200))]
    (tmp_path / "log.csv").write_text("\n".join(["time,float", *rows]) + "\n")
    words = ("advise", "log.csv", "--environment", "tank:mine/Tank-v0", "--report", "report.html")
    done = subprocess.run(
        [sys.executable, "-m", "filtergym", *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "<html" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_report_without_its_extra_is_refused_before_anything_is_read(monkeypatch, refusal):
    monkeypatch.setitem(sys.modules, "filtergym.reports.pages.html_report", None)
    assert "reports need more packages" in refusal("advise", "missing.csv", "--report", "advice.html")
