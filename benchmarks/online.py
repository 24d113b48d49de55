"""Filters in a user's loop: equality of bits with a replay, and time of an update against filterpy and Stone Soup.

Tracks with missed scans are written as a log. Each is replayed by an evaluation, and passed row by row to the running
filter, which is saved and restored by pickle in between. Then every filter processes the same plots of one track, in
rounds of updates in turn; the times are of the processor. A peer that is not installed is left out.

Example: python benchmarks/online.py --tracks 5 --plots 2000
"""

import argparse
import gc
import pickle
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy

import filtergym
from filtergym.envs.data.recording import Recording
from filtergym.envs.logs.reading import read_recording
from filtergym.papers.grid import markdown_table

ID = "filtergym/ManeuveringTarget-v0"
COMPETITORS = ("imm", "kalman-imm", "kalman-imm-turn", "adaptive-rearm", "sage-husa", "bptt", "kalman-net")
PEER, PEER_OF_TWO = "filterpy, IMM of two Kalman filters", "filterpy, Kalman filter of two states"
OF_TWO = "Kalman filter of two states"
"""Names of a user's model, and of filterpy's filter of the same model."""
ROUND = 100
"""Updates of one filter before the next one's turn."""
T, SIGMA, MISSED, SAVED_EVERY = 4.0, 100.0, 0.1, 500


def write_log(path: Path, tracks: int, plots: int) -> numpy.ndarray:
    """Write a log of random-walk tracks; return its rows of track number, time, x and y."""
    rng = numpy.random.default_rng(0)
    rows = []
    for track in range(tracks):
        velocity = numpy.array([120.0, -60.0]) + numpy.cumsum(rng.normal(scale=4.0, size=(plots, 2)), axis=0)
        velocity -= numpy.linspace(0.0, 1.0, plots)[:, None] * velocity.mean(axis=0)
        position = numpy.array([2e4, 3e4]) + T * numpy.cumsum(velocity - velocity.mean(axis=0), axis=0)
        position += SIGMA * rng.standard_normal(position.shape)
        position[2:][rng.random(plots - 2) < MISSED] = numpy.nan
        seconds = T * numpy.arange(plots) + rng.uniform(-0.2, 0.2, plots)
        rows.append(numpy.column_stack([numpy.full(plots, track), seconds, position]))
    table = numpy.round(numpy.concatenate(rows), 6)
    lines = [",".join("" if numpy.isnan(v) else repr(float(v)) for v in row) for row in table]
    path.write_text("recording,time,x,y,sigma_x,sigma_y\n" + f",{SIGMA},{SIGMA}\n".join([*lines, ""]))
    return table


def differing_updates(name: str, recording: Recording, table: numpy.ndarray) -> tuple[int, int]:
    """Return the number of updates of a running filter, and of those that differ from the replay in any bit."""
    replayed = filtergym.evaluate(
        ID, name, recording, episodes=len(recording.names), tracks=True, sampling_interval=T
    )
    parameters = {**recording.typical, **recording.parameters}
    filter = filtergym.online(ID, name, **parameters)
    count = differing = 0
    for episode, track in enumerate(numpy.unique(table[:, 0])):
        rows = table[table[:, 0] == track]
        filter.start(recording.initial["mean"][episode], recording.initial["covariance"][episode], rows[1, 1])
        wanted = replayed["estimate"].values[
            0, list(replayed["flight"].values).index(recording.names[episode])
        ]
        for k, (_, seconds, x, y) in enumerate(rows[2:]):
            estimate = filter.update(seconds, x=x, y=y, sigma_x=SIGMA, sigma_y=SIGMA)
            if k < len(wanted) and numpy.isfinite(wanted[k]).all():
                count, differing = count + 1, differing + (not numpy.array_equal(estimate.mean, wanted[k]))
            if k % SAVED_EVERY == SAVED_EVERY - 1:
                state = pickle.dumps(filter.save())
                filter = filtergym.online(ID, name, **parameters)
                filter.restore(pickle.loads(state))
    return count, differing


def own_update(name: str, backend: str) -> Callable[[float, float, float], object]:
    filter = filtergym.online(ID, name, backend=backend)
    filter.start([2e4, 3e4, 0.0, 0.0], numpy.diag([1e4, 1e4, 600.0, 600.0]))
    return lambda seconds, x, y: filter.update(seconds, x=x, y=y)


def own_update_of_two() -> Callable[[float, float, float], object]:
    filtergym.state_space(
        "mine/OfTwo-v0", f=[[1, 1.0], [0, 1]], h=[[1, 0]], Q=[[0.25, 0.5], [0.5, 1.0]], R=[[25.0]],
        mean=[0, 10], covariance=[[100, 0], [0, 25]],
    )  # fmt: skip
    filter = filtergym.online("mine/OfTwo-v0", "kalman")
    filter.start(mean=[0, 10], covariance=[[100, 0], [0, 25]])
    return lambda seconds, x, y: filter.update(values=[x])


def filterpy_update_of_two() -> Callable[[float, float, float], object]:
    from filterpy.kalman import KalmanFilter

    one = KalmanFilter(dim_x=2, dim_z=1)
    one.F, one.H = numpy.array([[1.0, 1.0], [0.0, 1.0]]), numpy.array([[1.0, 0.0]])
    one.Q, one.R = numpy.array([[0.25, 0.5], [0.5, 1.0]]), numpy.array([[25.0]])

    def update(seconds: float, x: float, y: float) -> None:
        one.predict()
        one.update(x)

    return update


def filterpy_update() -> Callable[[float, float, float], object]:
    """Return a function that updates filterpy's IMM of two Kalman filters with time, x and y."""
    from filterpy.kalman import IMMEstimator, KalmanFilter

    filters = []
    for acceleration in (0.0, 2.775):
        one = KalmanFilter(dim_x=4, dim_z=2)
        G = numpy.vstack([T**2 / 2 * numpy.eye(2), T * numpy.eye(2)])
        one.x, one.F, one.H = (
            numpy.array([2e4, 3e4, 0.0, 0.0]),
            numpy.eye(4) + T * numpy.eye(4, k=2),
            numpy.eye(2, 4),
        )
        one.P, one.R = numpy.diag([1e4, 1e4, 600.0, 600.0]), SIGMA**2 * numpy.eye(2)
        one.Q = acceleration**2 * G @ G.T
        filters.append(one)
    estimator = IMMEstimator(filters, numpy.array([0.5, 0.5]), numpy.array([[0.9, 0.1], [0.1, 0.9]]))

    def update(seconds: float, x: float, y: float) -> None:
        estimator.predict()
        estimator.update(numpy.array([x, y]))

    return update


def stone_soup_update() -> Callable[[float, float, float], object]:
    from datetime import datetime, timedelta

    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    predictor = KalmanPredictor(
        CombinedLinearGaussianTransitionModel([ConstantVelocity(7.7), ConstantVelocity(7.7)])
    )
    sensor = LinearGaussian(4, [0, 2], SIGMA**2 * numpy.eye(2))
    updater, begun = KalmanUpdater(sensor), datetime(2000, 1, 1)
    track = GaussianState([[2e4], [0.0], [3e4], [0.0]], numpy.diag([1e4, 600.0, 1e4, 600.0]), timestamp=begun)

    def update(seconds: float, x: float, y: float) -> None:
        nonlocal track
        moment = begun + timedelta(seconds=seconds)
        prediction = predictor.predict(track, timestamp=moment)
        detection = Detection([[x], [y]], timestamp=moment, measurement_model=sensor)
        track = updater.update(SingleHypothesis(prediction, detection))

    return update


def latencies(
    cases: Mapping[str, Callable[[float, float, float], object]], updates: int
) -> dict[str, numpy.ndarray]:
    """Return the processor seconds of each update, ``(updates,)``, of each filter by name, after a warm-up."""
    rng = numpy.random.default_rng(1)
    plots = numpy.array([2e4, 3e4]) + SIGMA * rng.standard_normal((updates + ROUND, 2))
    found = {name: numpy.empty(len(plots)) for name in cases}
    gc.disable()
    for first in range(0, len(plots), ROUND):
        for name, update in cases.items():
            for k, (x, y) in enumerate(plots[first : first + ROUND].tolist(), first):
                begin = time.process_time()
                update(T * (k + 1), x, y)
                found[name][k] = time.process_time() - begin
    gc.enable()
    return {name: seconds[ROUND:] for name, seconds in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tracks", type=int, default=5)
    parser.add_argument("--plots", type=int, default=2000, help="of each track")
    parser.add_argument("--updates", type=int, default=5000, help="that are timed")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        table = write_log(path, args.tracks, args.plots)
        recording = read_recording(path, ID, speeds=(0.001, 1000.0), sampling_interval=T)
        for name in COMPETITORS:
            count, differing = differing_updates(name, recording, table)
            print(f"{name}: {count:,} updates, {differing:,} with other bits than the replay", flush=True)
    print()
    cases = {f"`kalman`, {OF_TWO}": own_update_of_two()}
    cases |= {f"`{name}`": own_update(name, "auto") for name in COMPETITORS}
    cases |= {'`kalman-imm` with `backend="numpy"`': own_update("kalman-imm", "numpy")}
    peers = {PEER_OF_TWO: filterpy_update_of_two, PEER: filterpy_update}
    for name, make in {**peers, "Stone Soup, one Kalman filter": stone_soup_update}.items():
        with suppress(ImportError):
            cases[name] = make()
    found = latencies(cases, args.updates)
    rows = []
    for name, seconds in found.items():
        median, late = numpy.median(seconds), numpy.quantile(seconds, 0.999)
        peer = found.get(PEER_OF_TWO if OF_TWO in name else PEER)
        ratio = "" if peer is None else f"{numpy.median(peer) / median:.1f}"
        rows.append((name, f"{1e6 * median:.0f}", f"{1e6 * late:.0f}", ratio))
    print("\n".join(markdown_table(("", "median, µs", "99.9 %, µs", "filterpy's median over it"), rows)))


if __name__ == "__main__":
    main()
