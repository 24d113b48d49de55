"""Drives of the NCLT data set as logs with a second sensor: fixes of a receiver, wheels and heading, truth.

python docs/examples/nclt_odometry.py filternet/data/nclt_fusion nclt

The first folder is of a checkout of https://github.com/SongJgit/filternet; it needs torch.
"""

import sys
from pathlib import Path

import numpy
import torch

NAMES = "time,x,y,sigma_x,sigma_y,odometry_x,odometry_y,truth_position_x,truth_position_y"


def write_drives(data: Path, folder: Path) -> None:
    """Write a table of every drive, one row a second."""
    folder.mkdir(parents=True, exist_ok=True)
    for part in ("test", "val"):
        for drive in torch.load(data / f"{part}.pt", weights_only=True):
            fixes, truth, wheels = (
                drive[name].numpy().astype(float) for name in ("gps", "ground_truth", "wheel")
            )
            # Of the wheels left and right speeds, m/s; of the IMU the heading from x to y, rad.
            speed, heading = wheels[:, :2].mean(axis=1), wheels[:, 2]
            moved = speed[:, None] * numpy.stack([numpy.cos(heading), numpy.sin(heading)], axis=1)
            # The fixes have no deviations; a missing one repeats its predecessor, and is left out as a repetition.
            columns = [numpy.arange(len(fixes)), fixes, numpy.full_like(fixes, 5.0), moved, truth]
            file = folder / f"{drive['data_date']}.csv"
            numpy.savetxt(file, numpy.column_stack(columns), "%.6f", ",", header=NAMES, comments="")


if __name__ == "__main__":
    write_drives(Path(sys.argv[1]), Path(sys.argv[2]))
