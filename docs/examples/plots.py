"""Radar plots of two aircraft as a table, as a radar could write them: range, azimuth, no truth.

python docs/examples/plots.py plots.csv
"""

import csv
import sys
from pathlib import Path

import numpy


def write_plots(path: Path) -> None:
    """Write ranges (m) and azimuths (degrees clockwise from north) of two tracks, one scan every 4 s."""
    generator = numpy.random.default_rng(0)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["recording", "time", "range", "azimuth"])
        for name, speed, turn_rate in (("straight", 180.0, 0.0), ("turning", 150.0, 2.0)):
            course, east, north = numpy.radians(60.0), -20e3, 15e3
            for time in 4.0 * numpy.arange(80):
                if 120.0 <= time < 180.0:
                    course += numpy.radians(4.0 * turn_rate)
                east, north = east + 4.0 * speed * numpy.sin(course), north + 4.0 * speed * numpy.cos(course)
                distance = numpy.hypot(east, north) + generator.normal(0.0, 100.0)
                azimuth = numpy.degrees(numpy.arctan2(east, north)) % 360.0 + generator.normal(0.0, 0.25)
                writer.writerow([name, f"{time:g}", f"{distance:.1f}", f"{azimuth:.3f}"])


if __name__ == "__main__":
    write_plots(Path(sys.argv[1] if len(sys.argv) > 1 else "plots.csv"))
