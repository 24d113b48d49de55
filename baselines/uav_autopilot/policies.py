"""Policies of UavAutopilot, and the table of its baselines.

Equation numbers are those of the task's paper (Gridnev, Rusetski, Rak).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy

from ...envs.contract.model import Model
from ...envs.contract.observation import Reader
from ...envs.uav_autopilot.banks import MODES
from ...envs.uav_autopilot.level_bank import TRAINING, VAGUE, LevelBank, LevelPrior
from ...evaluation.competitors.kinds import Policy, RandomPolicy
from ..table import Baselines, ConstantMode, PaperAction, Tunable, Variant, tunable
from .alarm import AutopilotAlarm
from .estimators import ESTIMATORS, GustInteractingMultipleModel
from .metrics import METRICS
from .references import KnownNoiseBound, Matched, TrueState


class Kalman(PaperAction):
    """The paper's filter, equations (10)-(12), with the process noise of the design."""

    control = "gain"


class InnovationAdaptive(Policy):
    """Policy that scales the process noise by a window of normalised innovations squared (NIS).

    The logarithm of the factor is ``memory`` times the last one, plus ``weights`` times the logarithm of the
    innovations' mean square of each sensor over an exponential window; the mean square of a consistent filter
    is one. By default all sensors have the same positive weight, the textbook's rule. Only tuned weights can
    distinguish gusts from a noisier sensor.

    Args:
        window: effective length of the window, measurements.
        memory: factor on the last logarithm, 0 to 1.
        offset: logarithm (base 10) of the factor when the innovations are as predicted.
        weights: decades of the factor per decade of each sensor's mean square.
    """

    control = "gain"
    traceable = True

    def __init__(
        self,
        model: Model,
        window: float = 50.0,
        memory: float = 0.5,
        offset: float = 0.0,
        weights: tuple[float, ...] | None = None,
    ) -> None:
        super().__init__(model)
        self.forget: float = 1.0 / window
        self.memory = memory
        self.unit: float = 1.0 / self.task.parameters.gain_decades
        self.offset = offset
        m = len(self.task.sensors)
        self.weights = numpy.array([1.0 / m] * m if weights is None else (*weights, *[0.0] * m)[:m])
        self.innovation: Reader = model.reader("innovation")
        self.available: Reader = model.reader("available")
        self.last_action: Reader = model.reader("action")

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the logarithm of the factor on the process noise as action, and the window's mean squares as
        memory.
        """
        squared = self.innovation(observation) ** 2
        # A window starts with the mean square of a consistent filter.
        mean = numpy.where(start[:, None], 1.0, 1.0 if state is None else state)
        mean = mean + self.forget * self.available(observation) * (squared - mean)
        # One column after the other in memory: the last bit of the product depends on it.
        decades = numpy.copy(numpy.log10(numpy.maximum(mean, 1e-12)), order="F") @ self.weights
        wanted = self.unit * (self.offset + decades)
        action = self.memory * self.last_action(observation)[:, 0] + (1.0 - self.memory) * wanted
        return numpy.clip(action, -1.0, 1.0)[:, None], mean


def _make_tuned_adaptive(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
    weights = tuple(values[name] for name in ("output_weight", "rate_weight", "elevator_weight"))

    def make(model: Model) -> Policy:
        return InnovationAdaptive(model, values["window"], values["memory"], values["offset"], weights)

    return {}, make


_MEMORY = (20.0, 100.0, 400.0)
_WEIGHT = (-3.0, 1.0 / 3.0, 3.0)
BANKS: dict[str, Any] = {
    "level-bank": LevelBank,
    **{
        f"level-bank-{1 + points}": Variant(
            LevelBank,
            f"`level-bank` with {1 + points} hypotheses in place of 8, and 5 levels of each sensor in place of 9.",
            gust_points=points,
            sensor_points=5,
        )
        for points in (2, 3)
    },
    "level-bank-vague": Variant(
        LevelBank,
        "The level bank with one vague prior for all flights: wider levels, outliers, a biased rate sensor, a slow "
        "actuator.",
        prior=VAGUE,
    ),
}


def _tunable_bank(name: str, prior: LevelPrior) -> Tunable:
    found = tunable(
        BANKS[name],
        log10_gust_change=(-3.5, math.log10(prior.gust_change), -1.0),
        log10_sensor_change=(-4.0, math.log10(prior.sensor_change), -1.0),
        nominal=(0.02, prior.nominal, 0.5),
        kept=(0.1, prior.kept, 0.9),
    )
    return replace(found, in_lanes=False)


TUNABLE = {
    "innovation-adaptive": tunable(
        InnovationAdaptive,
        _make_tuned_adaptive,
        window=(5.0, 50.0, 150.0),
        memory=(0.0, 0.5, 0.95),
        offset=(-1.0, 0.0, 1.0),
        output_weight=_WEIGHT,
        rate_weight=_WEIGHT,
        elevator_weight=_WEIGHT,
    ),
    "mehra": tunable(ESTIMATORS["mehra"], window=_MEMORY),
    "sage-husa": tunable(ESTIMATORS["sage-husa"], memory=_MEMORY, gust_memory=_MEMORY),
    "variational-bayes": tunable(ESTIMATORS["variational-bayes"], memory=_MEMORY, gust_memory=_MEMORY),
    "gust-imm": tunable(
        GustInteractingMultipleModel,
        memory=(10.0, 50.0, 150.0),
        stay=(0.95, 0.99, 0.9995),
        low=(0.1, 0.5, 0.9),
        high=(1.2, 2.0, 4.0),
    ),
    "level-bank": _tunable_bank("level-bank", TRAINING),
    "level-bank-vague": _tunable_bank("level-bank-vague", VAGUE),
}

BASELINES = Baselines(
    environment="filtergym/UavAutopilot-v0",
    policies={
        "kalman": Kalman,
        "over-smoothed": Variant(
            ConstantMode,
            "A filter that trusts its model too much: process noise times 0.01.",
            mode=MODES.index("over-smoothed"),
        ),
        "wide-band": Variant(
            ConstantMode,
            "A filter that trusts its sensors too much: process noise times 100.",
            mode=MODES.index("wide-band"),
        ),
        "raw-sensors": Variant(
            ConstantMode,
            "No filter: the readings are fed back, the last valid one during a dropout.",
            mode=MODES.index("raw-sensors"),
        ),
        "innovation-adaptive": InnovationAdaptive,
        "random": RandomPolicy,
    },
    estimators={
        **ESTIMATORS,
        **BANKS,
    },
    references={"true-state": TrueState, "matched": Matched},
    bounds={"known-noise-bound": KnownNoiseBound},
    score_paper="kalman",
    score_reference="matched",
    tunable=TUNABLE,
    fallback="level-bank-vague",
    alarm=AutopilotAlarm,
    physical=("tracking_rmse", ""),
    benchmark=(
        "kalman",
        "over-smoothed",
        "wide-band",
        "raw-sensors",
        "innovation-adaptive",
        "gust-imm",
        "sage-husa",
        "level-bank",
        "level-bank-4",
        "random",
        "true-state",
        "matched",
        "steady-kalman",
        "known-noise-bound",
    ),
    metrics=METRICS,
)
