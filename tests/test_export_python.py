import json
import pickle
import subprocess
import sys
import types
from pathlib import Path

import numpy
import pytest
from filtergym.baselines.fitted_filters import families_of
from filtergym.baselines.problem import import_problem
from filtergym.envs.engine.backend import make_model
from filtergym.evaluation.competitors import kind_of
from filtergym.evaluation.evaluate import control_of
from filtergym.evaluation.rollout import rollout, start_lanes

from filtergym.exports.exported_filter import lane_of
from filtergym.exports.python_source import clean, export_python
from filtergym.exports.request import request_export
from filtergym.names import find_competitor

RADAR = "filtergym/ManeuveringTarget-v0"
QUICK = [
    (RADAR, "kalman-imm-turn"),
    (RADAR, "zero"),
    ("filtergym/LooselyCoupledNavigation-v0", "augmented-gain-mehra-tuned"),
    ("filtergym/RadarEsmTracking-v0", "quasi-optimal"),
    ("filtergym/TightlyCoupledNavigation-v0", "nis-adaptive"),
    ("filtergym/UavAutopilot-v0", "gust-imm"),
    ("filtergym/UavAutopilot-v0", "bptt"),
    ("filtergym/UavAutopilot-v0", "bptt-small"),
    ("filtergym/LooselyCoupledNavigation-v0", "bptt-linear"),
]
ENVIRONMENTS = list(dict.fromkeys(env for env, _ in QUICK))
ALONE = """
import importlib.util, pickle, sys
sys.path = [sys.argv[1], *[p for p in sys.path if 'site-packages' not in p]]
import numpy
for missing in ('filtergym', 'gymnasium', 'scipy'):
    assert importlib.util.find_spec(missing) is None, missing
for name, lanes in pickle.load(open('replay.pickle', 'rb')).items():
    module = __import__(name)
    for start, replay in lanes:
        track = module.OnlineFilter()
        track.start(**start)
        for measurement, mean, covariance, said in replay:
            estimate = track.update(**measurement)
            assert numpy.array_equal(estimate.mean, mean), name
            assert numpy.array_equal(estimate.covariance, covariance, equal_nan=True), name
            for key, value in said.items():
                assert numpy.array_equal(estimate.statistics[key], value, equal_nan=True), (name, key)
            assert list(estimate.named().values()) == list(mean)
print('same')
"""
SAID = ("log_likelihood", "nis", "nis_degrees", "mode_probability")


def replay(env, name, episodes=2, measurements=40, **keywords):
    """What the package answers: for each episode its start, and for each measurement that, mean, covariance, more."""
    problem = import_problem(env)
    maker = find_competitor(problem, name)
    kind = kind_of(maker)
    control = control_of(maker, kind, None, problem.task, str(name))
    keywords = {**getattr(maker, "task_keywords", {}), **keywords}
    model = make_model(problem.task, control, **keywords)
    starts, seeds = [], list(range(episodes))
    start_lanes(model, seeds, starts.append)

    def report(model, episode):
        said = {key: v for key, v in model.records(episode).items() if key in SAID}
        return episode.measurement, model.mean(episode), model.covariance(episode), said

    answers = []
    for (measurement, mean, covariance, said), _ in rollout(model, maker, seeds, report, kind=kind):
        told = {key: v for key, v in said.items() if not numpy.isnan(v).all()}
        answers.append((measurement, mean, covariance, told))
        if len(answers) == measurements:
            break
    return [
        (
            lane_of(starts[0].measurement, i),
            [
                (lane_of(m, i), mean[..., i], P[..., i], {key: v[..., i] for key, v in said.items()})
                for m, mean, P, said in answers
            ],
        )
        for i in range(episodes)
    ]


def module_of(text):
    module = types.ModuleType("written")
    sys.modules["written"] = module  # where pickle finds its classes
    exec(compile(text, "written.py", "exec", dont_inherit=True), module.__dict__)
    return module


def check_replay(text, lanes):
    for start, measurements in lanes:
        track = module_of(text).OnlineFilter()
        track.start(**start)
        for measurement, mean, covariance, said in measurements:
            estimate = track.update(**measurement)
            numpy.testing.assert_array_equal(estimate.mean, mean)
            numpy.testing.assert_array_equal(estimate.covariance, covariance)
            for key, value in said.items():
                numpy.testing.assert_array_equal(estimate.statistics[key], value)


def written_filter(env, name, *arguments, **options):
    return export_python(request_export(import_problem(env), name, *arguments, **options))


@pytest.fixture(scope="module")
def written():
    return {case: written_filter(case[0], case[1]) for case in QUICK}


def test_files_say_the_same_bits_where_there_is_numpy_alone(written, tmp_path):
    packages = Path(numpy.__file__).parent.parent
    alone = tmp_path / "alone"
    alone.mkdir()
    for part in packages.glob("numpy*"):
        (alone / part.name).symlink_to(part)
    lanes = {}
    for i, (case, text) in enumerate(written.items()):
        (alone / f"filter_{i}.py").write_text(text)
        lanes[f"filter_{i}"] = replay(*case, episodes=2 if i else 16)  # one of which misses scans
    (alone / "replay.pickle").write_bytes(pickle.dumps(lanes))
    run = subprocess.run(
        [sys.executable, "-I", "-S", "-c", ALONE, str(alone)],
        check=False,
        cwd=alone,
        capture_output=True,
        text=True,
    )
    assert run.stdout == "same\n", run.stderr
    missed = [m["available"] for _, each in lanes["filter_0"] for m, *_ in each]
    assert 0.0 in missed
    assert 1.0 in missed


@pytest.mark.slow
@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_every_ranked_competitor_says_the_same_bits(env):
    from filtergym.agents.named_policies import pretrained_agents

    problem = import_problem(env)
    known = problem.baselines
    names = [*known.policies, *known.estimators, *problem.tuned_policies, *pretrained_agents(env)]
    for name in names:
        if name != "random":
            check_replay(written_filter(env, name), replay(env, name, 3, 60))


def test_only_numpy_and_python_are_imported(written):
    for text in written.values():
        imported = {line.split()[1] for line in text.splitlines() if line.startswith(("import ", "from "))}
        assert imported - {"numpy"} <= set(sys.stdlib_module_names) | {"collections.abc"}


def test_comments_equations_and_units_come_along(written):
    text = written[RADAR, "kalman-imm-turn"]
    assert "Mixed inputs of the M filters, equations (8) and (9)." in text
    assert "(I - K H) P(k|k-1) (I - K H)^T" in written[RADAR, "zero"]
    assert '("velocity_x", "m/s")' in text
    uncompressed = written["filtergym/UavAutopilot-v0", "gust-imm"]
    assert "# " in uncompressed
    assert "class UavAutopilot" in uncompressed


def test_worlds_stay_behind(written):
    for text in written.values():
        assert "def advance(self, truth" not in text
        assert "def error_cost" not in text
        assert "gymnasium.spaces" not in text


def test_tracks_side_by_side_are_each_what_it_is_alone(written):
    lanes = replay(RADAR, "kalman-imm-turn", 3, 10)
    track = module_of(written[RADAR, "kalman-imm-turn"]).OnlineFilter()

    def together(parts):
        return {key: numpy.stack([part[key] for part in parts], axis=-1) for key in parts[0]}

    track.start(**together([start for start, _ in lanes]))
    for k in range(10):
        estimate = track.update(**together([each[k][0] for _, each in lanes]))
        numpy.testing.assert_array_equal(estimate.mean, numpy.stack([e[k][1] for _, e in lanes], axis=-1))
        assert estimate.covariance.shape == (4, 4, 3)
        assert estimate.statistics["nis"].shape == (3,)


def test_memory_goes_back_to_where_it_was(written):
    (start, measurements), *_ = replay("filtergym/UavAutopilot-v0", "bptt", 1, 20)
    written_module = module_of(written["filtergym/UavAutopilot-v0", "bptt"])
    track = written_module.OnlineFilter()
    track.start(**start)
    for measurement, *_ in measurements[:10]:
        track.update(**measurement)
    kept = pickle.dumps(track.memory)
    for _ in range(2):
        track.memory = pickle.loads(kept)
        for measurement, mean, *_ in measurements[10:]:
            numpy.testing.assert_array_equal(track.update(**measurement).mean, mean)


def test_another_shape_is_refused(written):
    track = module_of(written[RADAR, "zero"]).OnlineFilter()
    with pytest.raises(ValueError, match=r"covariance must have shape \(4, 4\), got \(4,\)"):
        track.start(mean=[0.0, 0.0, 0.0, 0.0], covariance=[1.0, 1.0, 1.0, 1.0])


def test_parameters_of_the_scenario_and_ones_own_are_in_force():
    text = written_filter(RADAR, "zero", "paper", gains=(0.2, 0.6))
    assert "regular: Any = True" in text
    assert "gain_alpha=numpy.array([[0.2], [0.6]])" in text
    check_replay(text, replay(RADAR, "zero", 1, 5, scenario="paper", gains=(0.2, 0.6)))


def test_a_fitted_filter_with_an_evil_name_is_text(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    problem = import_problem(RADAR)
    name = 'a"""\nopen("injected", "w")\n\\.filter.json'
    family = families_of(problem)["imm-turn"]
    values = {"environment": RADAR, "filter": "imm-turn", "values": dict(family.start)}
    Path(name).write_text(json.dumps(values))
    text = written_filter(RADAR, Path(name))
    module = module_of(text)
    assert not Path("injected").exists()
    assert module.__doc__.splitlines()[0].startswith("a''' open('injected', 'w') /: a filter of")
    check_replay(text, replay(RADAR, Path(name), 1, 5))


def test_words_of_strangers_stay_on_their_line_within_a_docstring():
    assert clean('m"""\n\r\x00\u2028\\') == "m''' /"


OWN = '''
import numpy
from filtergym.envs.maneuvering_target.world import Measurement

# The gain of this estimator is a constant.
GAIN = 0.5
"""Of the position."""


class Own:
    """Follows the measured position."""

    def __init__(self, task):
        self.task, self.label = task, 'of"""mine'

    def start(self, initial, N):
        return initial.mean, initial.covariance

    def update(self, measurement: Measurement, memory):
        mean, covariance = memory
        # A scan that missed the target changes nothing.
        seen = numpy.where(measurement.available > 0.0, GAIN, 0.0)
        moved = seen * (numpy.nan_to_num(measurement.position) - mean[:2])
        if self.label == 'of"""mine':
            mean = numpy.concatenate([mean[:2] + moved, mean[2:]])
        return mean, covariance, (mean, covariance)
'''


def test_an_estimator_of_ones_own_is_written(tmp_path, monkeypatch):
    (tmp_path / "own_gain.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    text = written_filter(RADAR, "own_gain:Own")
    assert "# A scan that missed the target changes nothing." in text
    assert 'GAIN = 0.5\n"""Of the position."""' in text
    check_replay(text, replay(RADAR, "own_gain:Own", 1, 5))


LACKING = '''
import scipy.linalg


class Own:
    """Takes SciPy."""

    def start(self, initial, N):
        return initial.mean, initial.covariance

    def update(self, measurement, memory):
        return *memory, (memory[0], scipy.linalg.block_diag(1.0))
'''


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("random", "draws its actions"),
        ("known-turn", "is of kind reference: only policies and estimators"),
        ("imm-smoother", "is of kind smoother"),
        ("own_scipy:Own", "own_scipy takes scipy, and the file is to need NumPy only"),
    ],
)
def test_what_cannot_be_written_is_refused_in_one_sentence(name, reason, tmp_path, monkeypatch):
    (tmp_path / "own_scipy.py").write_text(LACKING)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=reason) as refusal:
        written_filter(RADAR, name)
    assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_a_users_environment_is_written(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent.parent / "docs" / "examples")
    env = "inverted_pendulum:mine/InvertedPendulum-v0"
    check_replay(written_filter(env, "matching"), replay(env, "matching", 1, 20))


TWICE = '''
import numpy
from dataclasses import dataclass

from filtergym.filters import kalman as math
from filtergym.filters.kalman import Update


@dataclass(frozen=True)
class Settings:
    """What is set."""

    gain: float
    unread: str = "no"


def update(mean, innovation, settings: "Settings"):
    """Has the name of Kalman's."""
    return mean + settings.gain * innovation


class Own:
    """Names that stand for several things."""

    def __init__(self, task):
        self.settings, self.transition = Settings(0.25), (lambda x: 2.0 * x)

    def start(self, initial, N):
        return initial.mean, initial.covariance

    def update(self, measurement, memory):
        mean, P = memory
        seen = measurement.available > 0.0
        H, R = numpy.eye(2, 4), numpy.eye(2)[:, :, None] * measurement.variance
        kalman = math.update(mean, P, numpy.nan_to_num(measurement.position), H, R)
        mean = numpy.where(seen, Update(*kalman).mean, self.transition(mean) / 2.0)
        shift = numpy.where(seen, 1.0, 0.0) * numpy.ones((4, 1))
        return update(mean, shift, self.settings), P, (mean, P)
'''


def test_names_that_two_modules_have_are_told_apart(tmp_path, monkeypatch):
    (tmp_path / "own_twice.py").write_text(TWICE)
    monkeypatch.syspath_prepend(tmp_path)
    text = written_filter(RADAR, "own_twice:Own")
    assert "def kalman_update(" in text
    assert "def own_twice_update(" in text
    assert 'Settings(gain=0.25, unread="no")' in text
    check_replay(text, replay(RADAR, "own_twice:Own", 1, 5))
