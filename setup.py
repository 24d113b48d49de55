"""Finds the packages: the folders at the top level are rooms of one import package, ``filtergym``."""

from setuptools import find_packages, setup

ROOMS = ("compiler", "filters", "envs", "evaluation", "baselines", "agents")
FRONT = find_packages("filtergym", exclude=("papers", "papers.*", *ROOMS, *(f"{room}.*" for room in ROOMS)))
"""What is found in the folder ``filtergym`` itself: the rooms are links there, and papers are not installed."""

setup(
    packages=[
        *("filtergym", *(f"filtergym.{name}" for name in FRONT)),
        *(f"filtergym.{room}" for room in ROOMS),
        *(f"filtergym.{room}.{name}" for room in ROOMS for name in find_packages(room)),
    ]
)
