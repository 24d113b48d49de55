"""The report: what its file of results keeps, what its page shows, and that nothing of it is executed."""

import base64
import functools
import gzip
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import markupsafe
import numpy as np
import pytest
from contract import assert_properties
from made_results import results_of

from filtergym.evaluation.figures.front_figure import FrontPanel
from filtergym.evaluation.running.curves import evenly_spaced
from filtergym.evaluation.running.times import points_of_records
from filtergym.reports.pages.html_report import report_html
from filtergym.reports.pages.outcome import find_lead, outcome_sentences, own_sentences
from filtergym.reports.tables.headline import headline_table
from filtergym.reports.tables.ranking import best_of_origins, remarks
from filtergym.reports.tables.reasons import reason_sentences
from filtergym.reports.tables.results import (
    MOST_SHOWN,
    MOST_TIMES,
    Settings,
    read_all_results,
    read_results,
    select_competitors,
    settings_of,
    write_results,
)
from filtergym.reports.tables.terminal_tables import (
    consistency_word,
    results_tables,
    with_interval,
)

ENV = "filtergym/ManeuveringTarget-v0"
NAMES = ["imm", "adaptive-rearm-tuned", "kalman-imm-tuned", "ppo", "known-turn", "known-input-bound"]
HOSTILE = (
    "</script><script>window.stolen=1</script><img src=x onerror='window.stolen=2'>\"'`${window.stolen=3}"
)
SETTINGS = Settings("filtergym benchmark", {"filtergym": "0.1.0"})
PICTURE = "data:image/svg+xml;base64,"


@pytest.fixture(scope="module")
def result():
    return results_of(ENV, NAMES, None, 12)


def hostile(result, text=HOSTILE):
    """A result in which every name and word is an attack."""
    renamed = {name: f"{name}{text}" for name in {record.policy for record in result.records}}
    records = [
        r._replace(
            policy=renamed[r.policy], environment=text, scenario=text, control=text, unit=text, split=text,
            component=r.component and r.component + text, kind=r.kind, window=r.window + text * (r.window != "all"),
        )
        for r in result.records
    ]  # fmt: skip
    curves, track = (
        data.assign_coords(policy=[renamed[name] for name in data["policy"].values.tolist()])
        for data in (result.curves, result.track)
    )
    curves = curves.assign_attrs(best=renamed[curves.attrs["best"]]).assign_coords(
        quantity=[f"{name}{text}" for name in curves["quantity"].values.tolist()],
        unit=("quantity", [text] * curves.sizes["quantity"]),
    )
    return result._replace(
        environment=text,
        scenario=text,
        description=text,
        paper=renamed[result.paper],
        reference=renamed[result.reference],
        learned=[renamed[name] for name in result.learned],
        knows=dict.fromkeys(renamed.values(), text),
        notes=[text],
        records=records,
        curves=curves,
        track=track.assign_attrs(seed=text),
        causes=dict.fromkeys(result.causes, text),
        explained=[renamed[name] for name in result.explained],
        worst=[
            one._replace(
                policy=renamed[one.policy],
                opponent=renamed[one.opponent],
                seed=text,
                causes=[text],
                track=one.track.assign_coords(
                    policy=[renamed[n] for n in one.track["policy"].values.tolist()]
                ),
            )
            for one in result.worst
        ],
    )


class Page(HTMLParser):
    """Elements of a page that could run something, and its packed data."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.scripts, self.handlers, self.addresses, self.packed, self.inside = [], [], [], [], None
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.handlers += [name for name in given if name.startswith("on")]
        self.addresses += [
            given[name] for name in ("src", "href", "action", "data", "srcset") if name in given
        ]
        if tag in ("script", "iframe", "object", "embed", "form", "base", "link"):
            self.inside = given.get("type", "")
            self.scripts.append(self.inside if tag == "script" else tag)
            if self.inside == "text/plain":
                self.packed.append("")

    def handle_data(self, data):
        if self.inside == "text/plain":
            self.packed[-1] += data.strip()

    def handle_endtag(self, tag):
        if tag == "script":
            self.inside = None


def unpacked(text):
    return gzip.decompress(base64.b64decode(text)).decode()


def test_results_are_read_as_they_were_written(result, tmp_path):
    write_results(tmp_path / "results.json", [result], SETTINGS)
    [read], settings = read_results(tmp_path)
    assert settings == SETTINGS
    without = {"curves": None, "track": None, "worst": []}
    assert read._replace(**without) == result._replace(**without)
    assert [one._replace(track=None) for one in read.worst] == [
        one._replace(track=None) for one in result.worst
    ]
    pairs = [(getattr(result, name), getattr(read, name)) for name in ("curves", "track")]
    pairs += [(one.track, other.track) for one, other in zip(result.worst, read.worst, strict=True)]
    for (before, after), tolerance in zip(pairs, (5e-4, 1e-3, 1e-3, 1e-3, 1e-3), strict=True):
        assert set(before.variables) == set(after.variables)
        for key, values in before.data_vars.items():
            # Four significant digits, seven of positions.
            np.testing.assert_allclose(after[key].values, values.values, rtol=tolerance, atol=1e-12)


def test_a_file_of_results_is_bounded(result):
    assert result.curves.sizes["time"] <= MOST_TIMES
    assert evenly_spaced(6000, 100)[[0, -1]].tolist() == [0, 5999]
    assert evenly_spaced(3, 100).tolist() == [0, 1, 2]
    names = select_competitors(result.records, "imm", "known-turn", ["ppo"])
    assert names[:2] == ["imm", "known-turn"]
    assert len(names) <= MOST_SHOWN


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: {**d, "format": 99}, "no file of results"),
        (lambda d: {**d, "settings": None}, "fields of a Settings"),
        (lambda d: {**d, "results": None}, "no list of results"),
        (lambda d: {**d, "results": [{**d["results"][0], "records": []}]}, "no records"),
        (lambda d: {**d, "results": [{**d["results"][0], "scenario": "x"}]}, "another environment or scenario"),
        (lambda d: {**d, "results": [{**d["results"][0], "learned": 3}]}, "learned must be"),
        (lambda d: {**d, "results": [{**d["results"][0], "worst": [3]}]}, "worst episode needs its fields"),
        (
            lambda d: {
                **d, "results": [{**(r := d["results"][0]), "worst": [{**r["worst"][0], "cost": 1e999}]}],
            },
            "must be finite",
        ),
        (lambda d: {**d, "results": [{**d["results"][0], "curves": {"coords": {}}}]}, "expected coords"),
        (
            lambda d: {**d, "results": [{**d["results"][0], "track": {"coords": {}, "variables": {}, "attrs": {}}}]},
            "lack policy",
        ),
    ],
)  # fmt: skip
def test_a_file_of_something_else_is_refused(change, message, result, tmp_path):
    write_results(tmp_path / "results.json", [result], SETTINGS)
    values = json.loads((tmp_path / "results.json").read_text())
    (tmp_path / "results.json").write_text(json.dumps(change(values)))
    with pytest.raises(ValueError, match=message):
        read_results(tmp_path)


def test_several_files_make_one_report_but_no_scenario_twice(result, tmp_path):
    other = result._replace(
        scenario="other", records=[r._replace(scenario="other") for r in result.records], default=False
    )
    for name, found in (("a", result), ("b", other)):
        write_results(tmp_path / f"{name}.json", [found], settings_of(f"filtergym {name}"))
    results, settings = read_all_results([tmp_path / "a.json", tmp_path / "b.json"])
    assert [found.scenario for found in results] == ["random", "other"]
    assert settings.command == "filtergym a\nfiltergym b"
    with pytest.raises(ValueError, match="more than once"):
        read_all_results([tmp_path / "a.json"] * 2)


def test_headline_fits_a_narrow_terminal(result, command_console):
    text = command_console(80, headline_table([result]))
    assert max(map(len, text.splitlines())) <= 80
    for origin, name in best_of_origins(result):
        assert re.search(rf"{origin}\s+{name}\s", text)
    assert "…" not in text


@pytest.mark.parametrize("width", [100, 200])
def test_rows_of_ones_own_are_marked(width, result, command_console):
    own = {r.policy for r in result.records if r.policy != "ppo"}
    records = [
        r._replace(policy=f"isolated:mine_{r.policy}:Filter") if r.policy in own else r
        for r in result.records
    ]
    own = {r.policy for r in records} - {"ppo"}
    tables = results_tables(records, {}, width, user_names=own)
    text = command_console(width, *tables)
    assert text.count("> isolated:mine") == len(own) * len(tables)
    assert "> ppo" not in text
    assert "> marks your own." in tables[-1].caption


@pytest.mark.parametrize("width", [80, 100, 200])
def test_no_number_is_cut_at_any_width(width, result, command_console):
    tables = results_tables(result.records, result.knows, width)
    text = command_console(width, *tables)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    for name in ("rmse", "geometric_cost_difference"):
        for r in result.records:
            if (r.metric, r.window, r.policy) == (name, "all", "ppo") and r.component in ("", "position"):
                shown = f"{r.value * (100.0 if name != 'rmse' else 1.0):#.3g}".rstrip(".")
                assert shown in text
    # From a hundred columns on one table holds everything; the errors have their intervals where there is room.
    assert len(tables) == (1 if width >= 100 else 2)
    position = next(
        r for r in result.records if (r.metric, r.window, r.component) == ("rmse", "all", "position")
    )
    assert (with_interval(position) in text) == (width != 100)
    assert ("shows the intervals of the RMSE" in tables[-1].caption) == (width == 100)


@pytest.fixture
def command_console():
    def shown(width, *tables):
        import io

        from rich.console import Console

        stream = io.StringIO()
        console = Console(width=width, file=stream)
        for table in tables:
            console.print(table)
        return stream.getvalue()

    return shown


def test_consistency_in_a_word():
    """Consistent where the interval of the mean NEES holds one, however near or far the mean is."""
    words = {
        (0.9, 0.8, 1.01): "consistent",
        (1.6, 0.9, 4.0): "consistent",
        (1.02, 1.01, 1.03): "slightly overconfident",
        (0.98, 0.97, 0.99): "slightly cautious",
        (2.1, 2.0, 2.2): "overconfident",
        (0.4, 0.3, 0.5): "cautious",
        (1.0, 1.0, 1.0): "no interval",
        (1.0, None, None): "no interval",
        (None, None, None): "unknown",
    }
    assert {
        ends: consistency_word(SimpleNamespace(value=ends[0], low=ends[1], high=ends[2])) for ends in words
    } == words
    assert consistency_word(None) == "unknown"


def test_only_who_is_consistent_is_called_so(result):

    def sentences(low):
        consistency = {"value": 1.1, "low": low, "high": 1.2}
        records = [
            r._replace(**consistency) if (r.metric, r.window) == ("anees", "all") else r
            for r in result.records
        ]
        return remarks([result._replace(records=records)])

    assert any(
        "The winner states a covariance that does not fit" in s and "1.1" in s for s in sentences(1.05)
    )
    assert "The covariance of every winner is as large as its errors." in sentences(0.9)


def test_remarks_follow_from_the_numbers(result):
    def changed(metric, **values):
        records = [
            r._replace(**values) if (r.metric, r.policy) == (metric, "ppo") else r for r in result.records
        ]
        return remarks([result._replace(records=records)])

    helped = changed("geometric_cost_difference", value=-0.5, low=-0.6, high=-0.4)
    assert helped[0].startswith("The learned agent is not significantly worse")
    harmed = changed("geometric_cost_difference", value=0.5, low=0.4, high=0.6)
    assert harmed[0].startswith("The learned agent is significantly worse")
    assert "`ppo`" in harmed[0]
    unsure = changed("relative_cost_difference", value=0.5, low=None, high=None)
    assert unsure[0].startswith("The learned agent is not significantly worse")
    assert not any("learned agents" in sentence for sentence in remarks([result._replace(learned=[])]))


COSTS = {  # value and interval of the difference to the paper's algorithm, kind, nanoseconds
    "imm": (0.0, 0.0, 0.0, "policy", 70.0),
    "mine": (-0.5, -0.53, -0.47, "estimator", 2000.0),
    "net": (-0.4, -0.44, -0.38, "policy", 900.0),
    "small": (-0.3, -0.35, -0.25, "policy", 80.0),
    "quick": (-0.1, -0.15, -0.05, "policy", 60.0),
}


def made(result, costs, behind):
    """The result with other competitors: their differences to the paper's algorithm, times, and to the best one."""
    like = {r.metric: r for r in result.records if r.window == "all" and not r.component}
    records = []
    for name, (value, low, high, kind, nanoseconds, *ends) in costs.items():
        shortest, longest = ends or (None, None)
        own = {"policy": name, "kind": kind}
        records += [
            like["geometric_cost"]._replace(**own, value=1.0 + value, low=1.0 + low, high=1.0 + high),
            like["geometric_cost_difference"]._replace(**own, value=value, low=low, high=high),
            like["cost"]._replace(
                **own,
                metric="nanoseconds",
                value=nanoseconds,
                low=shortest,
                high=longest,
                component="compiled",
            ),
        ]
        if name in behind:
            value, low, high = behind[name]
            best = min(costs, key=lambda name: costs[name][0])
            found = {"metric": "behind_best", "component": best, "value": value, "low": low, "high": high}
            records.append(like["cost"]._replace(**own, **found))
    return result._replace(records=records, learned=["net", "small"], paper="imm", default=True)


@pytest.mark.parametrize(
    ("changes", "behind", "sentence"),
    [
        (
            {},
            {"net": (0.2, 0.15, 0.26)},
            "ManeuveringTarget: the classical filter `mine` has half the error cost of the paper's `imm` (47 to"
            " 53 % less); the best learned one, `net`, is 20 % behind it (15 to 26 %), and leads where a "
            "measurement may take 80 to 2,000 ns.",
        ),
        (
            {
                "mine": (*COSTS["mine"], 850.0, 2000.0),
                "net": (*COSTS["net"], 880.0, 910.0),
                "small": (*COSTS["small"], 55.0, 85.0),
            },
            {"net": (0.2, 0.15, 0.26)},
            "ManeuveringTarget: the classical filter `mine` has half the error cost of the paper's `imm` (47 to"
            " 53 % less); the best learned one, `net`, is 20 % behind it (15 to 26 %); where a measurement may take "
            "80 to 900 ns, the learned `small` leads.",
        ),
        (
            {name: (*COSTS[name], 10.0, 3000.0) for name in COSTS},
            {"net": (0.2, 0.15, 0.26)},
            "ManeuveringTarget: the classical filter `mine` has half the error cost of the paper's `imm` (47 to"
            " 53 % less); the best learned one, `net`, is 20 % behind it (15 to 26 %); the times of this run are "
            "too uncertain to be compared.",
        ),
        (
            {"mine": (0.3, 0.2, 0.4, "estimator", 2000.0), "quick": (-0.3, -0.34, -0.26, "policy", 60.0)},
            {"quick": (0.15, 0.1, 0.2)},
            "ManeuveringTarget: the learned policy `net` has 40 % less error cost than the paper's `imm` (38 to"
            " 44 %); the best classical one, `quick`, is 15 % behind it (10 to 20 %).",
        ),
        (
            {name: (0.2, 0.1, 0.3, *COSTS[name][3:]) for name in COSTS if name != "imm"},
            {"net": (0.2, 0.1, 0.3)},
            "ManeuveringTarget: the paper's `imm` has the lowest error cost; the best learned one, `net`, is 20"
            " % behind it (10 to 30 %).",
        ),
        (
            {"mine": (-0.98, -0.99, -0.95, "estimator", 50.0)},
            {"net": (29.0, 11.0, 55.0)},
            "ManeuveringTarget: the classical filter `mine` has 98 % less error cost than the paper's `imm` (95"
            " to 99.0 %); the best learned one, `net`, costs 30 times as much (12 to 56 times).",
        ),
        (
            {"mine": (-0.41, -0.8, 0.1, "estimator", 50.0)},
            {"net": (0.02, -0.01, 0.05)},
            "ManeuveringTarget: the classical filter `mine` is level with the paper's `imm`; the best learned "
            "one, `net`, is level with it.",
        ),
    ],
)
def test_the_sentence_follows_from_the_numbers(changes, behind, sentence, result):
    assert outcome_sentences([made(result, {**COSTS, **changes}, behind)]) == [sentence]


def naive_leaders(costs, learned):
    """Times, in steps of one nanosecond, at which the cheapest learned one costs less beyond the intervals."""
    found = []
    for time in range(1, 4000):
        mine = [c for name, c in costs.items() if name in learned and c[4] <= time]
        others = [c for name, c in costs.items() if name not in learned and c[4] <= time]
        if mine and others and min(mine)[2] < min(others)[1]:
            found.append(time)
    return found


def test_a_lead_is_where_a_naive_search_finds_it(result):
    """Where no two times are within ten per cent, which would count as the same."""
    assert_properties(list(range(40)), (functools.partial(has_the_lead_of_a_naive_search, result),))


def has_the_lead_of_a_naive_search(result, seed):
    rng = np.random.default_rng(seed)
    costs = {}
    for i, name in enumerate(["imm", "a", "b", "net", "small"]):
        value, width = float(rng.uniform(-0.6, 0.2)), float(rng.uniform(0.01, 0.1))
        costs[name] = (value, value - width, value + width, "policy", float(50 * 2**i))
    times = rng.permutation([cost[4] for cost in costs.values()])
    costs = {name: (*cost[:4], float(time)) for (name, cost), time in zip(costs.items(), times, strict=True)}
    records = made(result, costs, {}).records
    lead = find_lead(records, ["net", "small"], "learned")
    naive = naive_leaders(costs, ["net", "small"])
    assert (lead is None) == (not naive)
    if lead is not None:
        assert lead.first in naive
        assert lead.first - 1.0 not in naive
        assert max(naive) == (3999 if lead.last == np.inf else lead.last - 1.0)


def test_page_holds_the_content_of_the_file(result):
    html = report_html([result], SETTINGS)
    page = Page(html)
    assert len(html) < 10e6
    data, plotly = map(unpacked, page.packed)
    assert plotly.startswith("/**\n* plotly.js")
    cell = json.loads(data)
    assert cell["curves"]["coords"]["policy"][1] == result.curves["policy"].values.tolist()
    assert [line["name"] for line in cell["lines"]] == cell["curves"]["coords"]["policy"][1]
    for name in NAMES:
        assert f'data-sort="{name}"' in html
    assert "filtergym benchmark" in html
    # Why: the sentences, a row for every cause that holds, and seeds that show an episode again.
    for sentence in reason_sentences(result.records, result.causes, "imm"):
        assert str(markupsafe.escape(sentence.removeprefix("imm: "))) in html
    assert html.count('<details class="why"') == len(
        {r.policy for r in result.records if r.metric == "cause_cost"}
    )
    assert '<td data-label="it holds">in turns and other manoeuvres</td>' in html
    assert [one.policy for one in result.worst] == ["imm"] * 3
    assert all(f"<code>{one.seed}</code>" in html for one in result.worst)
    # Every figure states in words what it shows.
    assert html.count('role="img"') == html.count('<div class="plot"') == 8
    assert not [address for address in page.addresses if not address.startswith("#")]


def test_the_page_begins_with_sentences_and_the_picture_of_cost_and_time(result):
    timed = made(result, {**COSTS, "quick $x$_{": COSTS["quick"]}, {"net": (0.2, 0.15, 0.26)})
    html = report_html([timed], SETTINGS)
    [picture] = [address for address in Page(html).addresses if not address.startswith("#")]
    assert base64.b64decode(picture.removeprefix(PICTURE)).startswith(b"<?xml")
    assert report_html([timed], SETTINGS) == html
    assert html.index("is 20 % behind it") < html.index("<table") < html.index(picture[:60])
    front = (
        "On the front, the quickest first: quick -10 % in 60 ns, small -30 % in 80 ns, net -40 % in 900 ns"
    )
    assert html.replace("\xa0", " ").count(front) == 2  # for eyes, and for those who cannot see the picture
    assert "There is no score: no reference takes part." in report_html(
        [timed._replace(reference="")], SETTINGS
    )


def test_a_filter_of_the_user_comes_first(result):
    """In the first sentence, in the first picture however much it costs, and marked in every table."""
    dear = {name: cost for name, cost in COSTS.items() if name != "mine"} | {
        "mine:<b>": (3.0, 2.5, 3.6, "estimator", 2000.0)
    }
    behind = {"net": (0.2, 0.15, 0.26), "mine:<b>": (5.7, 5.0, 6.5)}
    found = made(result, dear, behind)
    timed = found._replace(own=["mine:<b>"])
    [sentence] = own_sentences(timed.records, timed.own, "imm")
    assert sentence.startswith("`mine:<b>`: 4 times the error cost of `imm`, 6.7 times that of `net`; ")
    html = report_html([timed], SETTINGS)
    assert '<p class="yours"><strong><code>mine:&lt;b&gt;</code></strong>: 4 times the error cost' in html
    assert (
        html.index('<p class="yours">') < html.index("has 40 % less error cost than") < html.index("<table")
    )
    assert html.count('<tr class="yours">') == 2
    assert "Yours: mine:&lt;b&gt; +300 %" in html.replace("\xa0", " ")
    for own, top in ((timed.own, 300.0), ((), 100.0)):
        panel = FrontPanel("", points_of_records(found.records), "imm", "", ["net"], own)
        assert panel.top == pytest.approx(top)
        assert [point.name for point in panel.beyond] == ([] if own else ["mine:<b>"])


@pytest.mark.parametrize(
    ("cost", "phrase"),
    [
        ((0.425, 0.4, 0.45), "42.5 % more error cost than `imm`"),
        ((-0.3, -0.4, -0.2), "30.0 % less error cost than `imm`"),
        ((0.01, -0.02, 0.04), "level with `imm`"),
    ],
)
def test_a_sentence_compares_the_users_own(result, cost, phrase):
    records = made(result, {"imm": COSTS["imm"], "mine": (*cost, "estimator", 100.0)}, {}).records
    best = ", the lowest of all 2" if cost[0] < 0.0 else ""
    assert own_sentences(records, ["mine"], "imm") == [f"`mine`: {phrase}{best}; states no covariance."]


def test_nothing_of_a_hostile_file_becomes_markup(result, tmp_path):
    write_results(tmp_path / "results.json", [hostile(result)], Settings(HOSTILE, {HOSTILE: HOSTILE}))
    own, attacked = Page(report_html([result], SETTINGS)), Page(report_html(*read_results(tmp_path)))
    assert attacked.scripts == own.scripts == ["text/plain", "text/plain", ""]
    assert not attacked.handlers
    assert all(address.startswith(("#", PICTURE)) for address in attacked.addresses)


def test_an_environment_without_a_paper_or_a_track_has_a_report_too(result, command_console):
    compared = ("geometric_cost_difference", "relative_cost_difference", "score", "behind_best")
    records = [r for r in result.records if r.metric not in compared]
    alone = result._replace(paper="", reference="", learned=[], records=records, track=None, curves=None)
    html = report_html([alone], SETTINGS)
    assert 'data-kind="ranking"' not in html
    assert 'data-kind="track"' not in html
    assert "On <code>random</code> <code>" in html
    assert "kalman-imm-tuned" in command_console(80, headline_table([alone]))
