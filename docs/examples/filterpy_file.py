"""filterpy's IMM of filterpy_filters.py as a program of its own: measurements in, a file of estimates out.

filtergym record filtergym/ManeuveringTarget-v0 --episodes 100 --out episodes --blind
python filterpy_file.py episodes estimates.csv
filtergym evaluate filtergym/ManeuveringTarget-v0 --episodes 100 --policy file:estimates.csv --policy imm
"""

import csv
import sys

import numpy
from filterpy.kalman import IMMEstimator, KalmanFilter

NAMES = ("position_x", "position_y", "velocity_x", "velocity_y")
SIGMAS = (0.0, 2.775)


def begin(row):
    filters = [KalmanFilter(4, 2) for _ in SIGMAS]
    for one in filters:
        one.x = numpy.array([row[f"mean_{name}"] for name in NAMES])
        lower = numpy.array([[row.get(f"covariance_{a}_{b}", 0.0) for b in NAMES] for a in NAMES])
        one.P, one.H = numpy.tril(lower) + numpy.tril(lower, -1).T, numpy.eye(2, 4)
    return IMMEstimator(filters, (0.5, 0.5), numpy.array([[0.9, 0.1], [0.1, 0.9]]))


def step(imm, row):
    T, I = row["interval"], numpy.eye(2)
    G = numpy.vstack([T**2 / 2 * I, T * I])
    for one, sigma in zip(imm.filters, SIGMAS):
        one.F, one.Q = numpy.block([[I, T * I], [0 * I, I]]), sigma**2 * G @ G.T
        one.R = numpy.diag([row["variance_1"], row["variance_2"]])
    imm.predict()
    if row["available"]:
        imm.update([row["position_1"], row["position_2"]])
    else:  # filterpy takes over the predicted probabilities of its modes in an update only
        imm.mu = imm.cbar.copy()
        imm._compute_mixing_probabilities()
        imm._compute_state_estimate()


def rows(path):
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            yield {name: float(cell or "nan") for name, cell in row.items()}


folder, out = sys.argv[1:]
tracks = {row["track"]: begin(row) for row in rows(f"{folder}/start.csv")}
with open(out, "w", newline="") as file:
    write = csv.writer(file).writerow
    write(["track", "seconds", *NAMES, *(f"covariance_{a}_{b}" for a in NAMES for b in NAMES)])
    for row in rows(f"{folder}/measurements.csv"):
        imm = tracks[row["track"]]
        step(imm, row)
        write([row["track"], row["seconds"], *imm.x.ravel().tolist(), *imm.P.ravel().tolist()])
