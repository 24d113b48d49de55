"""Prior of the fault bank of LooselyCoupledNavigation, and the noise points of its hypotheses."""

import math
from typing import NamedTuple

import numpy

from ..contract.observation import Array
from .parameters import LooselyCoupledNavigationParameters

LEVELS = tuple(100 ** (i / 3) for i in range(-2, 5))
"""Ratios of true to reported receiver variance that the bank distinguishes."""


class FaultPrior(NamedTuple):
    """Prior of the fault bank: spoofing, noise levels and noises; times in s."""

    points: int = 6
    """Number of noise points beside the modelled one."""
    modelled: float = 0.5
    """Prior probability that all noises are as modelled and nothing is pulled off. Ours, one half: in the training
    distribution it is one sixth. With that the bank is a percent better there, but worse where nothing is wrong."""
    drift: tuple[float, float] = (0.05, 10**0.5)
    """Limits of the ratio of the drift's standard deviation to the modelled one."""
    intensity: tuple[float, float] = (0.005, 10**0.5)
    """Limits of the ratios of the coloured and white noises' intensities to the modelled ones."""
    wandering: tuple[float, float] = (0.0, 0.5)
    """Limits of the standard deviation of the receiver's coloured error, m."""
    lasting: tuple[float, float] = (0.5, 5.0)
    """Limits of the correlation time of that error."""
    onset: tuple[float, float] = (0.5, 3.5)
    """Earliest and latest onset of a pull."""
    onset_rate: float = 0.07
    """Expected number of pulls per second in that interval."""
    onsets: int = 6
    """B, number of onset hypotheses."""
    shortest: float = 0.5
    longest: float = 2.0
    rate: float = 3**0.5
    """Standard deviation of the rate of a pull, m/s."""
    levels: tuple[float, ...] = LEVELS
    """Ratios of true to reported receiver variance, ascending, one of them 1."""
    level_rate: float = 0.3
    """Expected number of level changes per second."""
    distrust: float = 0.05
    """Probability that the report is wrong from the start."""
    outlier: float = 0.0
    """Probability of an outlier."""
    outlier_factor: float = 100.0
    """Ratio of an outlier's variance to that of the others."""


TRAINING = FaultPrior()
VAGUE = FaultPrior(
    drift=(0.02, 5.0),
    intensity=(0.002, 10.0),
    wandering=(0.0, 1.5),
    lasting=(0.5, 20.0),
    onset=(0.0, math.inf),
    onset_rate=0.05,
    shortest=0.0,
    longest=3.0,
    rate=3.0,
    outlier=0.01,
)
FEW = TRAINING._replace(
    points=1,
    drift=(0.5, 0.5),
    intensity=(0.15, 0.15),
    wandering=(0.45, 0.45),
    onset_rate=0.35,
    onsets=2,
    levels=(0.2, 1.0, 10.0, 100.0),
)
"""Four filters: the modelled noises, others, and two onsets of a pull in these. Sizes and values chosen on the
validation split, by cost and by the density of the truth: with the middle of each limit of ``TRAINING`` the bank costs
a few percent less, and errs by nearly twice the variance that it states (ANEES 1.9)."""


def spread_points(points: int, dimensions: int) -> numpy.ndarray:
    """Return low-discrepancy points in the unit cube, ``(points, dimensions)``.

    Kronecker sequence of the powers of the root of ``x^(d + 1) = x + 1`` (Roberts, "The unreasonable effectiveness of
    quasirandom sequences", 2018).
    """
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    steps = root ** -numpy.arange(1.0, dimensions + 1)
    return (0.5 + numpy.arange(points)[:, None] * steps) % 1.0


class Noises(NamedTuple):
    """Noises of J hypotheses, arrays ``(J,)``, in the bank ``(J, 1, 1)``."""

    drift: Array
    """Standard deviation of the constant rate error, m/s."""
    coloured: Array
    """Stationary standard deviation of the coloured rate error, m/s."""
    coloured_growth: Array
    """Variance that the coloured rate error gains in a step, m^2/s^2."""
    white_growth: Array
    """Variance of the displacement in a step that this gain does not explain, m^2."""
    wandering: Array
    """Stationary standard deviation of the receiver's coloured error, m."""
    decay: Array
    """Factor on that error in a step."""


def draw_noises(prior: FaultPrior, p: LooselyCoupledNavigationParameters) -> Noises:
    """Return the noises of J hypotheses, spread evenly over the prior after the modelled ones, ``(J,)`` each."""
    interval = p.sampling_interval
    unit = spread_points(prior.points, 5).T

    def between(limits: tuple[float, float], where: numpy.ndarray) -> numpy.ndarray:
        return limits[0] * (limits[1] / limits[0]) ** where

    def after(first: float, others: numpy.ndarray) -> numpy.ndarray:
        return numpy.concatenate([[first], others])

    low, high = prior.wandering
    coloured = p.coloured * numpy.sqrt(after(1.0, between(prior.intensity, unit[1])))
    white = p.white_intensity * after(1.0, between(prior.intensity, unit[2]))
    return Noises(
        p.drift * after(1.0, between(prior.drift, unit[0])),
        coloured,
        (coloured * p.sampling.coloured) ** 2,
        white * interval + p.sampling.residual * coloured**2,
        after(0.0, low + (high - low) * unit[3]),
        numpy.exp(-interval / after(prior.lasting[0], between(prior.lasting, unit[4]))),
    )
