"""Finds the packages: the folders at the top level are rooms of one import package, ``filtergym``."""

from setuptools import find_packages, setup

ROOMS = ("compiler", "filters", "envs", "evaluation", "baselines", "agents")

setup(
    packages=[
        *("filtergym", *(f"filtergym.{name}" for name in find_packages("filtergym"))),
        *(f"filtergym.{room}" for room in ROOMS),
        *(f"filtergym.{room}.{name}" for room in ROOMS for name in find_packages(room)),
    ]
)
