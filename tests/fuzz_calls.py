"""Calls of ``online``, ``state_space`` and ``evaluate`` with odd arguments: each answers, or refuses in one sentence.

``python tests/fuzz_calls.py CALLS [SEED]``, which ``make fuzz`` runs too. A call fails that ends in an error which no
statement of this package raises, in one of another type than ``ValueError``, ``TypeError`` or one of Gymnasium's, in
more than one sentence, or takes longer than 60 s; and an estimate that is not finite and says nothing of it.
"""

import ast
import collections
import datetime
import functools
import linecache
import random
import signal
import sys
import traceback
import warnings
from pathlib import Path

import gymnasium
import numpy as np

SECONDS = 60
LONGEST = 1000
"""Characters of a sentence; some list what there is."""
TARGET = "filtergym/ManeuveringTarget-v0"
MEAN, COVARIANCE = [21e3, 30.5e3, -180.0, 40.0], np.diag([150.0, 150.0, 40.0, 40.0]) ** 2
ODD = (
    None, 0, -1, 1, 2, 2**31, 10**400, 0.5, -1e308, 1e308, 1e-320, float("nan"), float("inf"), True, 1j, "", "x", "imm",
    "\x00", "../x", "é" * 500, b"x", [], {}, (), {"x": 1}, [None], [[]], ["x", 1], [float("nan")], object(), object,
    len, lambda: 0, lambda x: x, lambda x, dt: x, np.array(5.0), np.array([1.0, 2.0]), np.eye(2), -np.eye(4),
    np.eye(4), np.zeros((4, 4)), np.ones((4, 4)), np.full((4, 4), np.nan), np.array(["x"]), np.array([None]),
    np.zeros((0, 3)), np.datetime64("2026-01-01"), np.float32(1.0), datetime.timedelta(1), datetime.timedelta(-1),
    range(3), {1, 2}, ..., Path("x"), Path("x.filter.json"), slice(1), [1.0] * 4, np.ma.masked, np.array([[1.0]]),
    "nan", 10**30,
)  # fmt: skip
MODEL = {
    "f": lambda x: [x[0] + 0.5 * x[1], x[1]], "h": [[1.0, 0.0]], "Q": [[0.1, 0.2], [0.2, 0.5]], "R": [[25.0]],
    "mean": [0.0, 10.0], "covariance": [[100.0, 0.0], [0.0, 25.0]],
}  # fmt: skip
MORE = {
    "names": ["p", "v"], "units": ["m", "m/s"], "measured": ["gps"], "weights": [1.0, 0.0],
    "filter_model": {"R": [[9]]}, "hypotheses": [{"Q": np.eye(2)}],
    "transition": [[0.9, 0.1], [0.2, 0.8]], "switching": False, "horizon": 20,
    "sampling_interval": 0.5, "process_noise": 1.0, "decision_interval": 1, "inputs": (),
    "sensors": None, "drift": None, "diffusion": None, "integration_steps": 1,
}  # fmt: skip
EVALUATED = {
    "competitors": "imm", "scenario": "paper", "episodes": 2, "seed": 0, "split": "test", "control": "mode",
    "progress": None, "trust": False, "horizon": 8, "decision_interval": 4, "range_sigma": 100.0, "backend": "numpy",
    "drawn_episodes": 1,
}  # fmt: skip
ONLINE = {
    "policy": "imm", "control": None, "scenario": None, "tracks": 1, "regular": False, "second_sensor": False, "lag": 0,
    "backend": "numpy", "trust": False, "range_sigma": 100.0,
}  # fmt: skip


class SlowError(BaseException):
    """A call took too long."""


def stop(*_) -> None:
    """End a call that takes too long."""
    raise SlowError


@functools.cache
def raised_lines(path: str) -> frozenset[int]:
    """Lines of a file that belong to a statement that raises."""
    tree = ast.parse("".join(linecache.getlines(path)))
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Raise | ast.Assert)]
    return frozenset(line for node in found for line in range(node.lineno, node.end_lineno + 1))


def explain_error(error: Exception) -> str:
    """Say what is wrong with an error; nothing if it is one sentence of this package."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    of_library = "site-packages" in frame.filename or "<" in frame.filename
    place = f"{Path(frame.filename).name}:{frame.lineno}"
    said = f"{type(error).__name__}: {str(error)!r:.200} at {place}"
    if not isinstance(error, ValueError | TypeError | gymnasium.error.Error):
        return f"of another type: {said}"
    if "fuzz_calls" in frame.filename and "unexpected keyword" not in str(error):
        return f"of no sentence: {said}"
    if not isinstance(error, gymnasium.error.Error) and (
        of_library or frame.lineno not in raised_lines(frame.filename)
    ):
        return f"raw: {said}"
    if "\n" in str(error) or not 10 < len(str(error)) < LONGEST:
        return f"not one sentence: {said}"
    return ""


def mix(honest: dict, rng: random.Random, most: int = 2) -> dict:
    """Return arguments of which one or some are odd."""
    changed = dict(honest)
    for name in rng.sample([*honest], rng.randrange(1, most + 1)):
        value = rng.choice(ODD)
        if rng.random() < 0.4 and isinstance(changed[name], list | dict | np.ndarray):
            value = nest(changed[name], rng)
        changed[name] = value
    return changed


def nest(value, rng: random.Random):
    """Return a list or a mapping of which a part is odd."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, list | dict) or not value or rng.random() < 0.2:
        return rng.choice(ODD)
    changed = dict(value) if isinstance(value, dict) else list(value)
    key = rng.choice([*value] if isinstance(value, dict) else range(len(value)))
    changed[key] = nest(value[key], rng)
    return changed


def call_state_space(rng: random.Random) -> None:
    """Make a model, and evaluate it where it is one."""
    from filtergym.baselines import catalogue
    from filtergym.envs.engine import registration

    import filtergym

    more = {name: MORE[name] for name in rng.sample([*MORE], 4)}
    id = "fuzzed/Call-v0" if rng.random() < 0.9 else rng.choice(ODD)
    try:
        filtergym.state_space(id, **mix({**MODEL, **more}, rng, 3))
        check(filtergym.evaluate(id, ["kalman"], None, 1, horizon=4))
    finally:
        for table in (registration.USER_TASKS, catalogue.USER_BASELINES, gymnasium.registry):
            for name in [name for name in table if "fuzzed/" in str(name)]:
                del table[name]


def call_evaluate(rng: random.Random) -> None:
    """Evaluate something."""
    import filtergym

    keep = rng.sample([*EVALUATED], rng.randrange(3, len(EVALUATED)))
    given = {"horizon": 8, "episodes": 2, "competitors": "imm", **{name: EVALUATED[name] for name in keep}}
    env = TARGET if rng.random() < 0.95 else rng.choice(ODD)
    given = mix(given, rng)
    if callable(given.get("progress")):
        given["progress"] = None  # what a function of the caller's raises is the caller's
    given |= {name: 2 for name in ("episodes", "horizon") if is_large(given[name])}
    check(filtergym.evaluate(env, **given))


def is_large(value) -> bool:
    """Whether it is a number of things that nobody waits for."""
    return isinstance(value, int) and value > 1000


def check(dataset) -> None:
    """Raise AssertionError for results that are not finite."""
    for name in ("cost", "log_likelihood"):
        if name in dataset:
            assert not np.isinf(dataset[name]).any(), f"{name} is infinite"


def check_estimate(estimate) -> None:
    """Raise AssertionError for an estimate that is none and does not say so."""
    mean, P = np.asarray(estimate.mean), np.asarray(estimate.covariance)
    lost = [estimate.lost] if mean.ndim == 1 else estimate.lost
    for track, said in enumerate(lost):
        x, p = (mean, P) if mean.ndim == 1 else (mean[..., track], P[..., track])
        finite = np.isfinite(x).all() and np.isfinite(p).all()
        assert said or (finite and (np.diag(p) > 0.0).all()), (
            f"not finite, and says {said!r}: {x} {np.diag(p)}"
        )


@functools.cache
def shared_filter(name: str, tracks: int):
    """A filter that many calls use, each from where it begins."""
    import filtergym

    return filtergym.online(TARGET, name, tracks=tracks)


def call_online(rng: random.Random) -> None:
    """Make a filter, or use one."""
    import filtergym

    if rng.random() < 0.25:
        env = TARGET if rng.random() < 0.95 else rng.choice(ODD)
        given = mix(ONLINE, rng)
        given["policy"] = (
            "imm" if callable(given["policy"]) else given["policy"]
        )  # errors of the caller's own code
        given["tracks"] = 2 if is_large(given["tracks"]) else given["tracks"]
        filter = filtergym.online(env, **given)
        filter.start(*([MEAN, COVARIANCE] if filter.tracks == 1 else start_of(filter.tracks)))
        check_estimate(filter.update(5.0, x=20310.0, y=30640.0))
        return
    tracks = rng.choice((1, 1, 3))
    filter = shared_filter(rng.choice(("imm", "kalman-imm-turn", "bptt-small", "semi-markov")), tracks)
    mean, covariance = start_of(tracks)
    kind = rng.randrange(5)
    if kind == 0:
        filter.start(**mix({"mean": mean, "covariance": covariance, "time": 0.0, "tracks": None}, rng))
        check_estimate(filter.update(5.0, x=20310.0, y=30640.0))
        return
    filter.start(mean, covariance)
    if kind == 1:
        honest = {"x": 20310.0, "y": 30640.0, "sigma_x": 100.0, "sigma_y": 100.0}
        check_estimate(filter.update(**mix({"time": 4.0, **honest}, rng)))
        check_estimate(filter.update(x=20310.0, y=30640.0))
    elif kind == 2:
        check_estimate(filter.update(**mix({"time": 4.0, "range": 36000.0, "azimuth": 30.0}, rng)))
    elif kind == 3:
        check_estimate(filter.predict(rng.choice(ODD)))
    else:
        first, second = {"time": 0.0, "x": 2e4, "y": 3e4}, {"time": 4.0, "x": 2e4, "y": 3e4}
        chance = rng.random()
        if chance < 0.2:
            filter.restore(rng.choice(ODD))
        elif chance < 0.6:
            saved = filter.save()
            filter.restore(saved._replace(**{rng.choice(saved._fields): rng.choice(ODD)}))
            check_estimate(filter.update(5.0, x=20310.0, y=30640.0))
        else:
            filter.start_from(mix(first, rng), rng.choice((second, rng.choice(ODD))))


def start_of(tracks: int) -> tuple:
    """Initial estimates of some tracks."""
    if tracks == 1:
        return MEAN, COVARIANCE
    repeated = np.repeat(np.array(MEAN)[:, None], tracks, axis=1)
    return repeated, np.repeat(COVARIANCE[..., None], tracks, axis=2)


def main(calls: int, seed: int = 0) -> int:
    """Make the calls, print what fails, and return how many did."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, stop)
    counts: collections.Counter = collections.Counter()
    failed: dict = {}
    kinds = (call_online, call_state_space, call_evaluate)
    for number in range(calls):
        call, rng = kinds[number % 3], random.Random(f"{seed} {number}")
        signal.alarm(SECONDS)
        said = ""
        try:
            call(rng)
            counts["taken"] += 1
        except SlowError:
            said = f"over {SECONDS} s"
        except Exception as error:
            said = explain_error(error)
            counts["refused"] += not said
        signal.alarm(0)
        if said:
            counts["failed"] += 1
            if said not in failed:
                print(f"{call.__name__} {seed} {number}: {said}", flush=True)
            failed[said] = number
    print(f"{calls:,} calls: {dict(counts)}; {len(failed)} ways to fail", flush=True)
    return counts["failed"]


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    sys.exit(min(main(*map(int, sys.argv[1:3])), 1))
