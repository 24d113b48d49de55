"""A learned estimator: a filter with a network inside, as plain arrays.

The filter is a bank of the environment (``Task.trained_banks``), the network is a learned policy that acts in it. From
outside there is neither observation nor action: measurements go in, mean and covariance come out.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy

from ..compiler.functions import map_arrays
from ..envs.contract.filter import Input
from ..envs.contract.model import Model
from ..envs.contract.observation import Array
from ..envs.contract.task import Task
from ..evaluation.competitors.kinds import Kind, Likelihood, Policy
from ..evaluation.competitors.steered_filter import Steered, steer


class LearnedEstimator:
    """A bank with the policy that closes it, see :class:`~..evaluation.competitors.Estimator`.

    Args:
        model: with the bank.
        network: a policy made for the bank, on NumPy.
        interval: measurements for which an action holds.
    """

    kind: ClassVar[Kind] = "estimator"
    traceable: ClassVar[bool] = True

    def __init__(self, model: Model, network: Policy, interval: int = 1) -> None:
        self.network = network
        self.filter = steer(model, network, interval)

    def start(self, initial: Any, N: int) -> Steered:
        """Start the filter where everyone starts."""
        return self.filter.start(initial)

    def update(self, measurement: Any, memory: Steered) -> tuple[Array, Array, Steered, Likelihood]:
        """Predict, show the network what comes of it, and update as it answers; what the bank does not tell of the
        likelihood is None.
        """
        measurement = fill_missing(measurement)
        state = self.filter.update(self.filter.predict(memory, measurement), Input(measurement))
        records = self.filter.records(state, measurement)
        likelihood = Likelihood(*(records.get(name) for name in Likelihood._fields))
        return self.filter.mean(state), self.filter.covariance(state), state, likelihood


def fill_missing(measurement: Any) -> Any:
    """Put numbers in place of what is missing: banks weigh values by their availability."""
    return map_arrays(numpy.nan_to_num, measurement)


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
        """Make it."""
        model = Model(task, self.bank)
        return LearnedEstimator(model, self.policy(model.on_numpy()))
