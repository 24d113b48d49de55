"""Numbers measured over Monte Carlo runs, with one kind of uncertainty: a bootstrap over the runs.

While it is computed, a quantity is an array with its value first and then its value in every bootstrap sample
of the runs. Whatever is computed from such arrays (ratios, roots, largest values) keeps its uncertainty, and
is paired where the runs face the same noise. An array of length one is exact.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy
import xarray

from ..evaluation.running.rollout import rollout
from ..evaluation.statistics.bootstrap import Bootstrap, percentile_interval
from ..functions import evaluate

RESAMPLES = 500


@lru_cache(maxsize=4)
def _resampling(runs: int) -> Bootstrap:
    return Bootstrap(runs, RESAMPLES)


class Quantity(NamedTuple):
    """A value, its 95 % interval and standard error.

    As text it is ``value ± standard error``, both in the digits of the format (``f"{m:.3f}"``, ``f"{m:+.1%}"``),
    or in two digits of the error (``f"{m}"``); the value alone where it is exact.
    """

    value: float
    low: float
    """2.5 % quantile of the bootstrap samples."""
    high: float
    error: float = math.nan
    """Their standard deviation, NaN where the value is exact."""

    def __format__(self, spec: str) -> str:
        if not spec:
            digits = 1 - math.floor(math.log10(self.error)) if self.error > 0.0 else 4
            spec = f".{max(digits, 0)}f"
        error = "" if math.isnan(self.error) else f" ± {self.error:{spec.lstrip('+')}}"
        text = f"{self.value:{spec}}{error}"
        return text.replace("%", "") + " %" if "%" in spec else text


def means(values: numpy.ndarray) -> numpy.ndarray:
    """Return the mean over runs, then over each bootstrap sample of the runs, ``(1 + resamples, ...)``."""
    return _resampling(len(values)).means(values)


def quantity(samples: numpy.ndarray) -> Quantity:
    """Return a :class:`Quantity` from its value followed by its bootstrap samples, ``(1 + resamples,)``."""
    if len(samples) == 1:
        return Quantity(*[float(samples[0])] * 3)
    value, low, high = percentile_interval(samples).tolist()
    return Quantity(value, low, high, float(samples[1:].std()))


def mean(values: numpy.ndarray) -> Quantity:
    """Return the mean of a number over the runs, ``(runs,)``, with its uncertainty."""
    return quantity(means(values))


def band(samples: numpy.ndarray) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return the bounds of the 95 % interval of curves, ``(1 + resamples, ...)``."""
    _, low, high = percentile_interval(samples)
    return low, high


def evaluate_policy(
    environment: str, name: str, scenario: str, episodes: int, **keywords: Any
) -> xarray.Dataset:
    """Evaluate a policy, reference or bound on test episodes, as one unit of work; return the dataset."""
    return evaluate(environment, [name], scenario, episodes, **keywords).isel(policy=0)


def record_run(
    task: Any, actor: Any, seeds: Sequence[int], fields: Callable[[Any, Any], Mapping[str, numpy.ndarray]]
) -> dict[str, numpy.ndarray]:
    """Run a policy or reference estimator, and return quantities that an evaluation does not record.

    ``fields`` maps the task and its state after a measurement to the values ``(..., N)``.

    Returns:
        The recorded values, ``(episodes, K, ...)`` with the other axes in reversed order.
    """
    # Lanes beyond the seeds are padding.
    kept = [
        {name: values[..., : len(seeds)].T for name, values in found.items()}
        for found, _ in rollout(task, actor, seeds, fields)
    ]
    return {name: numpy.stack([values[name] for values in kept], axis=1) for name in kept[0]}
