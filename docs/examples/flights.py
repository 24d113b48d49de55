"""Twenty files of flights to try sets with: one has gaps, one is in kilometres, one is no table.

python docs/examples/flights.py flights
"""

import sys
from pathlib import Path

import numpy


def write_flights(folder: Path) -> None:
    """Write ``ory_00.csv`` to ``ory_19.csv``: straight legs and turns, a position every 5 s."""
    folder.mkdir(parents=True, exist_ok=True)
    generator = numpy.random.default_rng(0)
    for number in range(20):
        count = int(generator.integers(60, 160))
        time = 5.0 * numpy.arange(count)
        leg = numpy.arange(count) // 20
        turning = generator.uniform(0.0, 1.0, 10)[leg] < 0.4
        rate = numpy.radians(generator.uniform(-3.0, 3.0, 10)[leg]) * turning
        course = generator.uniform(0.0, 2.0 * numpy.pi) + 5.0 * numpy.cumsum(rate)
        velocity = generator.uniform(80.0, 240.0) * numpy.stack([numpy.cos(course), numpy.sin(course)])
        position = generator.uniform(-40e3, 40e3, (2, 1)) + 5.0 * numpy.cumsum(velocity, axis=1)
        if number == 7:  # nothing was received for a while, twice
            time = time + 90.0 * (numpy.arange(count) > 4) + 90.0 * (numpy.arange(count) > 40)
        if number == 15:
            position = position / 1e3
        rows = numpy.column_stack([time, *position])
        numpy.savetxt(folder / f"ory_{number:02}.csv", rows, "%.3f", ",", header="time,x,y", comments="")
    (folder / "ory_11.csv").write_bytes(bytes(range(256)))


if __name__ == "__main__":
    write_flights(Path(sys.argv[1] if len(sys.argv) > 1 else "flights"))
