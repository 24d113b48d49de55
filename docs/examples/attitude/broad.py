"""Recordings of BROAD as scenarios: read where they lie, none are shipped.

BROAD [1] holds 39 trials of a hand-held sensor with an optical reference, at https://github.com/dlaidig/broad, under CC
BY 4.0. A trial is a ``.mat`` file of the folder ``data_mat``: ``imu_gyr`` (rad/s), ``imu_acc`` (m/s^2) and ``imu_mag``
(microtesla), ``(samples, 3)``, the true attitude ``opt_quat`` (to east, north, up; NaN where the cameras lost the
sensor), ``movement`` (which samples count) and ``sampling_rate`` (Hz).

As BROAD judges it, filters run over the whole trial and start from its first sample, and errors count while the sensor
moves: elsewhere the truth is left out.

[1] D. Laidig, M. Caruso, A. Cereatti, T. Seel, Data 6 (7), 72, 2021, doi:10.3390/data6070072.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy
import scipy.io
from filtergym.envs.data.recording import Recording, side_by_side
from scipy.spatial.transform import Rotation

from . import quaternions
from .task import Attitude

TO_NORTH_WEST_UP = numpy.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""From east, north, up."""
ARRAYS = ("imu_gyr", "imu_acc", "imu_mag", "opt_quat", "movement", "sampling_rate")


def read_trial(path: Path | str) -> Recording:
    """Read one trial.

    Args:
        path: of its ``.mat`` file.

    Raises:
        ValueError: if it is no such file, or lacks an array of a trial.
    """
    path = Path(path)
    try:
        trial = scipy.io.loadmat(path, appendmat=False, variable_names=ARRAYS)
    except (ValueError, NotImplementedError) as error:
        raise ValueError(f"{path} cannot be read as a .mat file: {error}") from error
    missing = [name for name in ARRAYS if name not in trial]
    if missing:
        raise ValueError(f"{path} is no trial of BROAD: it lacks {', '.join(missing)}")
    rate, force, field = (numpy.ascontiguousarray(trial[name]) for name in ARRAYS[:3])
    samples = len(rate)
    truth = numpy.full((samples, 9), numpy.nan)
    counted = trial["movement"].ravel().astype(bool) & numpy.isfinite(trial["opt_quat"]).all(axis=1)
    true = Rotation.from_quat(trial["opt_quat"][counted], scalar_first=True).as_matrix()
    truth[counted] = (TO_NORTH_WEST_UP @ true).reshape(-1, 9)
    start = quaternions.align(force[0][:, None], field[0][:, None])
    interval = 1.0 / float(trial["sampling_rate"].ravel()[0])
    task = Attitude(Attitude.Parameters(sampling_interval=interval))
    # Rounded: 2000 / 7 Hz is stored with fifteen digits.
    interval = float(f"{interval:.9g}")
    return Recording(
        environment=Attitude.id,
        measurements={"rate": rate[None], "force": force[None], "field": field[None]},
        initial={
            "mean": start.T,
            "covariance": numpy.moveaxis(task.stated_covariance(start[0]), -1, 0),
            "quaternion": quaternions.quaternion_of(start).T,
        },
        seconds=interval * numpy.arange(1, samples + 1)[None],
        lengths=numpy.array([samples]),
        truth=truth[None],
        names=(path.stem,),
        parameters={"sampling_interval": interval},
        name=path.stem,
        source="BROAD, https://github.com/dlaidig/broad",
        licence="CC BY 4.0",
    )


def read_trials(paths: Sequence[Path | str], name: str = "BROAD") -> Recording:
    """Read trials side by side.

    Args:
        paths: of their ``.mat`` files.
        name: of the whole.
    """
    trials = [read_trial(path) for path in paths]
    return side_by_side(trials, names=tuple(trial.name for trial in trials), name=name)
