"""The estimators of ManeuveringTarget by name, and what can be tuned in them.

Deviations and small probabilities are searched by their logarithm: their sizes are not known beforehand.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

from ..table import Tunable
from .adaptive_estimators import SageHusa, VariationalBayes, VariationalBayesPrediction
from .estimators import KalmanInteractingMultipleModel, KalmanTurnInteractingMultipleModel, UnscentedTurn

Applied = tuple[dict[str, Any], Callable[[Any], Any]]

ESTIMATORS = {
    "kalman-imm": KalmanInteractingMultipleModel,
    "kalman-imm-turn": KalmanTurnInteractingMultipleModel,
    "unscented-turn": UnscentedTurn,
    "sage-husa": SageHusa,
    "variational-bayes": VariationalBayes,
    "variational-bayes-prediction": VariationalBayesPrediction,
}


def _plain(values: Mapping[str, float]) -> dict[str, float]:
    """Values by their names, those searched by their logarithm without it."""
    return {
        name.removeprefix("log10_"): 10.0**value if name.startswith("log10_") else value
        for name, value in values.items()
    }


def _of_keywords(cls: Callable[..., Any]) -> Callable[[Mapping[str, float]], Applied]:
    """Of an estimator whose keywords are what is tuned."""
    return lambda values: ({}, lambda task: cls(task, **_plain(values)))


def _imm(values: Mapping[str, float]) -> Applied:
    accelerations = values["acceleration_quiet"], values["acceleration_noisy"]
    stay = values["stay_quiet"], values["stay_noisy"]
    return {}, lambda task: KalmanInteractingMultipleModel(task, accelerations, stay)


def _imm_turn(values: Mapping[str, float]) -> Applied:
    v = _plain(values)
    modes = ("quiet", "noisy", "turn")
    return {}, lambda task: KalmanTurnInteractingMultipleModel(
        task,
        [v[f"acceleration_{mode}"] for mode in modes],
        v["turn_rate_start"],
        v["turn_rate_change"],
        [1.0 - v[f"leave_{mode}"] for mode in modes],
    )


def _logarithms(**values: float) -> dict[str, float]:
    return {f"log10_{name}": math.log10(value) for name, value in values.items()}


_ACCELERATION = {"log10_acceleration": (-1.5, 1.0)}
_TURN_RATES = {"log10_turn_rate_start": (-1.0, 0.7), "log10_turn_rate_change": (-1.5, 0.3)}

TUNABLE = {
    "kalman-imm": Tunable(
        None,
        {
            "acceleration_quiet": (0.0, 0.5),
            "acceleration_noisy": (0.5, 10.0),
            "stay_quiet": (0.8, 0.999),
            "stay_noisy": (0.5, 0.999),
        },
        {"acceleration_quiet": 0.0, "acceleration_noisy": 2.775, "stay_quiet": 0.9, "stay_noisy": 0.9},
        _imm,
    ),
    "kalman-imm-turn": Tunable(
        None,
        {
            "log10_acceleration_quiet": (-3.0, -0.5),
            "log10_acceleration_noisy": (0.0, 1.0),
            "log10_acceleration_turn": (-1.0, 0.5),
            **_TURN_RATES,
            "log10_leave_quiet": (-3.0, -1.0),
            "log10_leave_noisy": (-3.0, -0.5),
            "log10_leave_turn": (-3.0, -0.5),
        },
        _logarithms(
            acceleration_quiet=0.05,
            acceleration_noisy=3.0,
            acceleration_turn=0.3,
            turn_rate_start=2.0,
            turn_rate_change=0.3,
            leave_quiet=0.05,
            leave_noisy=0.2,
            leave_turn=0.2,
        ),
        _imm_turn,
    ),
    "unscented-turn": Tunable(
        None,
        {**_ACCELERATION, **_TURN_RATES},
        _logarithms(acceleration=0.3, turn_rate_start=2.0, turn_rate_change=0.3),
        _of_keywords(UnscentedTurn),
    ),
    "sage-husa": Tunable(
        None,
        {**_ACCELERATION, "forgetting": (0.3, 0.99), "log10_least": (-2.0, 0.7)},
        {**_logarithms(acceleration=1.0, least=0.1), "forgetting": 0.9},
        _of_keywords(SageHusa),
    ),
    "variational-bayes": Tunable(
        None,
        {**_ACCELERATION, "forgetting": (0.5, 1.0), "log10_shape": (-0.3, 3.0)},
        {**_logarithms(acceleration=2.775, shape=5.0), "forgetting": 0.95},
        _of_keywords(VariationalBayes),
    ),
    "variational-bayes-prediction": Tunable(
        None,
        {**_ACCELERATION, "log10_strength": (-1.0, 2.0)},
        _logarithms(acceleration=1.0, strength=3.0),
        _of_keywords(VariationalBayesPrediction),
    ),
}
