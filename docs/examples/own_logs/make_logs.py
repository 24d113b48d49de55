"""Logs of five machines, simulated here in plain NumPy with finer steps than any filter takes.

python docs/examples/own_logs/make_logs.py logs

Of each machine two files: `NAME.csv`, one log to fit to, and `NAME_judged.csv`, ten others.
"""

import sys
from pathlib import Path

import numpy as np


def correlated(rng, steps, dt, deviation, time):
    """A Gauss-Markov process of a deviation and a correlation time, s, `(steps,)`."""
    kept, x = np.exp(-dt / time), np.empty(steps)
    x[0] = rng.normal(0.0, deviation)
    for k in range(1, steps):
        x[k] = kept * x[k - 1] + rng.normal(0.0, deviation * np.sqrt(1.0 - kept**2))
    return x


def gps_odometry(rng, seconds=120, dt=0.1):
    """A drone in wind: GPS of 2.5 m each second, velocity by camera of 0.15 m/s each 0.1 s, a tenth of it lost."""
    n = int(seconds / dt)
    v = np.array([correlated(rng, n, dt, 3.0, 10.0) + correlated(rng, n, dt, 0.3, 0.5) for _ in range(2)])
    p = rng.normal(0.0, 10.0, (2, 1)) + np.cumsum(v, axis=1) * dt
    fix = np.where(np.arange(1, n + 1) % 10 == 0, p + rng.normal(0.0, 2.5, (2, n)), np.nan)
    flow = np.where(rng.random(n) < 0.9, v + rng.normal(0.0, 0.15, (2, n)), np.nan)
    return {
        "time": np.arange(1, n + 1) * dt, "gps_x": fix[0], "gps_y": fix[1], "odometry_x": flow[0],
        "odometry_y": flow[1], "truth_x": p[0], "truth_y": p[1], "truth_vx": v[0], "truth_vy": v[1],
    }  # fmt: skip


def level_gauge(rng, days=10):
    """A reservoir: inflow wanders, the gauge drifts. It reports about each 10 minutes, a dip stick twice a day."""
    dt, n = 60.0, days * 1440
    rate = correlated(rng, n, dt, 0.05 / 3600, 6 * 3600)
    level = rng.normal(10.0, 0.1) + np.cumsum(rate) * dt
    offset = rng.normal(0.0, 0.05) + np.cumsum(rng.normal(0.0, 0.03 / np.sqrt(1440), n))  # 3 cm after a day
    times = np.cumsum(rng.exponential(600.0, 3 * n // 10).astype(int) // 60 + 1)
    times = times[times < n]
    dipped = np.array([(k // 720) != (k_before // 720) for k, k_before in zip(times[1:], times, strict=False)])
    stick = np.where(np.append(False, dipped), level[times] + rng.normal(0.0, 0.01, len(times)), np.nan)
    return {
        "time": times * dt, "gauge": level[times] + offset[times] + rng.normal(0.0, 0.02, len(times)), "stick": stick,
        "truth_level": level[times], "truth_rate": 3600 * rate[times], "truth_offset": offset[times],
    }  # fmt: skip


def pitch_roll(rng, seconds=30, dt=0.02, fine=10):
    """A drone that rolls over: gyroscope with drifting bias, accelerometer that also measures its accelerations."""
    n = int(seconds / dt)
    h = dt / fine
    p = 1.0 + correlated(rng, n * fine, h, 0.8, 1.0)
    q = correlated(rng, n * fine, h, 0.4, 0.5)
    roll, pitch = rng.normal(0.0, 0.1, (2, 1)) + np.zeros((2, n * fine))
    for k in range(1, n * fine):
        q[k] -= pitch[k - 1] * np.cos(roll[k - 1])  # its controller holds the pitch, also upside down
        roll[k] = roll[k - 1] + h * (p[k] + q[k] * np.sin(roll[k - 1]) * np.tan(pitch[k - 1]))
        pitch[k] = pitch[k - 1] + h * q[k] * np.cos(roll[k - 1])
    mean = lambda rate: rate.reshape(n, fine).mean(axis=1)  # noqa: E731
    bias = [rng.normal(0.0, 0.05) + np.cumsum(rng.normal(0.0, 0.002 * np.sqrt(dt), n)) for _ in range(2)]
    own = [correlated(rng, n, dt, 0.6, 0.2) for _ in range(3)]
    last = slice(fine - 1, None, fine)
    force = [
        9.81 * np.cos(pitch[last]) * np.sin(roll[last]) + own[0] + rng.normal(0.0, 0.1, n),
        9.81 * np.cos(pitch[last]) * np.cos(roll[last]) + own[1] + rng.normal(0.0, 0.1, n),
        9.81 * np.sin(pitch[last]) + own[2] + rng.normal(0.0, 0.1, n),
    ]
    return {
        "time": np.arange(1, n + 1) * dt, "gyro_p": mean(p) + bias[0] + rng.normal(0.0, 0.02, n),
        "gyro_q": mean(q) + bias[1] + rng.normal(0.0, 0.02, n), "roll_angle": np.arctan2(force[0], force[1]),
        "pitch_angle": np.arctan2(force[2], np.hypot(force[0], force[1])), "truth_roll": roll[last],
        "truth_pitch": pitch[last], "truth_bias_p": bias[0], "truth_bias_q": bias[1],
    }  # fmt: skip


def battery(rng, seconds=3600, dt=2.0):
    """A cell of 2.5 Ah under a driving cycle: two RC pairs, current of 30 mA with an offset, voltage of 5 mV."""
    n = int(seconds / dt)
    current = np.maximum(-2.0, 1.8 + correlated(rng, n, dt, 1.5, 20.0))
    charge = rng.normal(0.8, 0.1) - np.cumsum(current) * dt / (2.5 * 3600)
    pairs = np.zeros((2, n))
    for k in range(1, n):
        for pair, (R, seconds_) in enumerate(((0.015, 20.0), (0.01, 300.0))):
            a = np.exp(-dt / seconds_)
            pairs[pair, k] = a * pairs[pair, k - 1] + R * (1.0 - a) * current[k]
    open_circuit = 3.3 + 0.9 * charge - 0.6 * charge**2 + 0.55 * charge**3
    voltage = open_circuit - pairs.sum(axis=0) - 0.02 * current + rng.normal(0.0, 0.005, n)
    return {
        "time": np.arange(1, n + 1) * dt, "current": current + 0.02 + rng.normal(0.0, 0.03, n), "voltage": voltage,
        "truth_charge": charge, "truth_relaxation": pairs.sum(axis=0),
    }  # fmt: skip


def late_vision(rng, seconds=20, dt=0.01):
    """A rail: an accelerometer each 10 ms with a bias, and a camera each 200 ms with a delay of 150 ms."""
    n = int(seconds / dt)
    a = correlated(rng, n, dt, 1.5, 0.7)
    v = np.cumsum(a) * dt
    v -= np.linspace(0.0, v[-1], n)  # it comes to rest
    a = np.gradient(v, dt)
    p = rng.normal(0.0, 0.1) + np.cumsum(v) * dt
    bias = rng.normal(0.0, 0.2) + np.cumsum(rng.normal(0.0, 0.01 * np.sqrt(dt), n))
    seen = np.where(np.arange(n) % 20 == 0, p + rng.normal(0.0, 0.01, n), np.nan)
    return {
        "time": np.arange(1, n + 1) * dt, "acceleration": a + bias + rng.normal(0.0, 0.1, n), "camera": seen,
        "truth_position": p, "truth_velocity": v, "truth_bias": bias,
    }  # fmt: skip


MACHINES = {"gps_odometry": gps_odometry, "level_gauge": level_gauge, "pitch_roll": pitch_roll, "battery": battery}
MACHINES["late_vision"] = late_vision
JUDGED = 10


def write_logs(folder, machines=MACHINES):
    """Write the logs; the judged logs have other seeds than the fitted one."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in machines:
        for file, seeds in ((name, range(1)), (f"{name}_judged", range(1, 1 + JUDGED))):
            lines = []
            for seed in seeds:
                log = MACHINES[name](np.random.default_rng([seed, len(name)]))
                lines = lines or [",".join(["recording", *log])]
                rows = zip(*(column.tolist() for column in log.values()), strict=True)
                lines += [
                    ",".join([str(seed), *("" if x != x else f"{x:.9g}" for x in row)]) for row in rows
                ]
            (folder / f"{file}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_logs(Path(sys.argv[1]))
