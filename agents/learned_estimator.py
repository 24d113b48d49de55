"""A learned estimator: a filter with a network inside, as plain arrays.

The filter is a bank of the environment (``Task.trained_banks``), the network is a learned policy that acts in it. From
outside there is neither observation nor action: measurements go in, mean and covariance come out.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy

from ..compiler.functions import map_arrays
from ..envs.model import Episode, Model
from ..envs.observation import Array
from ..envs.task import Task
from ..evaluation.competitors import Kind, Policy


class EstimatorMemory(NamedTuple):
    """Memory of a learned estimator."""

    bank: Any
    """State of the filter."""
    network: Any
    """Memory of the network; None before the first measurement."""


class LearnedEstimator:
    """A trained bank with its network, see :class:`~..evaluation.competitors.Estimator`.

    Args:
        network: a policy made for the bank, on NumPy.
    """

    kind: ClassVar[Kind] = "estimator"

    def __init__(self, network: Policy) -> None:
        self.network, self.model = network, network.model

    def start(self, initial: Any, N: int) -> EstimatorMemory:
        """Start the filter where everyone starts."""
        return EstimatorMemory(self.model.filter.start(initial), None)

    def update(self, measurement: Any, memory: EstimatorMemory) -> tuple[Array, Array, EstimatorMemory]:
        """Predict, show the network what comes of it, and update as it answers."""
        bank: Any = self.model.filter
        measurement = map_arrays(numpy.nan_to_num, measurement)  # banks weigh values by their availability
        state = bank.predict(memory.bank, measurement)
        shown = self.model.observe(Episode(None, measurement, state))
        action, network = self.network.predict(shown.T, memory.network)
        # In double: arithmetic with constants would stay in the network's precision.
        state = bank.act(state, measurement, action.T.astype(float))
        return bank.mean(state), bank.covariance(state), EstimatorMemory(state, network)


class EstimatorMaker:
    """Makes a learned estimator for a task; what an evaluation calls.

    Args:
        bank: name of the filter in ``task.trained_banks``.
        policy: what makes the network for a model of that bank.
    """

    kind: ClassVar[Kind] = "estimator"

    def __init__(self, bank: str, policy: Callable[[Model], Policy]) -> None:
        self.bank, self.policy = bank, policy

    def __call__(self, task: Task) -> LearnedEstimator:
        """Make it on NumPy, whatever the task computes on."""
        return LearnedEstimator(self.policy(Model(task, self.bank).on_numpy()))
