"""Filters and agents on the real drive of ``drive.py``: a table in Markdown.

    python benchmarks/drive_filters.py docs/data/drive.nc

Each runs on one axis alone, as in the training of agents, with the two sets of levels that are likeliest in
``drive.py``: with any correlation time, and with that of the environment.
"""

import argparse
import dataclasses
from pathlib import Path

import filtergym
from filtergym.envs.data.recording import Recording
from filtergym.evaluation.running.metrics import Record
from filtergym.papers.grid import markdown_table

ID = "filtergym/LooselyCoupledNavigation-v0"
LEVELS: dict[str, dict[str, float]] = {
    "30 s": {},
    "1 s": {"correlation_time": 1.0, "drift": 0.75, "coloured": 0.83},
}
"""Parameters by the correlation time of the INS error; those of the file are of the first."""
COMPETITORS = (
    "augmented",
    "augmented-gain",
    "augmented-sage-husa",
    "best-constant",
    "bptt",
    "bptt-linear",
    "bptt-small",
    "fault-bank",
    "fault-bank-vague",
    "gated:bptt",
    "gated:ppo",
    "gnss-only",
    "innovation-adaptive",
    "ins-only",
    "kalman-net",
    "plain-reduced",
    "ppo",
)


def one_axis(drive: Recording, axis: int) -> Recording:
    """Return a recording reduced to one axis, as if the vehicle moved along it."""
    if drive.truth is None:
        raise ValueError("the drive needs its truth")
    mean, covariance = drive.initial["mean"], drive.initial["covariance"]
    return dataclasses.replace(
        drive,
        measurements={
            key: values[..., [axis]] if values.ndim == 3 else values
            for key, values in drive.measurements.items()
        },
        initial={"mean": mean[:, [axis]], "covariance": covariance[:, [axis]][..., [axis]]},
        truth=drive.truth[..., [axis]],
        parameters={**drive.parameters, "axes": 1},
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=Path, help="file of recordings that drive.py wrote")
    drive = filtergym.read_recording(parser.parse_args().drive, ID)
    header = ["competitor"]
    found: dict[str, list[Record]] = {name: [] for name in COMPETITORS}
    for level, parameters in LEVELS.items():
        for axis, direction in enumerate(("east", "north")):
            header.append(f"{direction}, {level}")
            alone = one_axis(drive, axis)
            results = filtergym.evaluate(alone.environment, list(COMPETITORS), scenario=alone, **parameters)
            for record in filtergym.tidy_records(results):
                if record.window == "all" and record.metric == "rmse":
                    found[record.policy].append(record)
    ranked = sorted(found.items(), key=lambda item: item[1][0].value)
    rows = [
        [f"`{name}`", *(f"{r.value:.3f} [{r.low:.3f}, {r.high:.3f}]" for r in own)] for name, own in ranked
    ]
    print("\n".join(markdown_table(header, rows)))


if __name__ == "__main__":
    main()
