"""The estimators of ManeuveringTarget by name, and their tunable values.

Deviations and small probabilities are searched by their logarithm, since their orders of magnitude are unknown.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from math import log10
from typing import Any

from ...envs.maneuvering_target.semi_markov import (
    TRAINING,
    VAGUE,
    WIDE,
    SemiMarkov,
    SemiMarkovPrior,
    training_prior,
)
from ...envs.maneuvering_target.unscented_turn import UnscentedTurn
from ..table import Tunable, Variant, tunable, without_logarithms
from .adaptive_estimators import SageHusaProcessNoise, VariationalBayes
from .data_association import (
    InteractingMultipleModelDataAssociation,
    ProbabilisticDataAssociation,
    SemiMarkovDataAssociation,
)
from .estimators import KalmanInteractingMultipleModel, KalmanTurnInteractingMultipleModel

Settings = tuple[dict[str, Any], Callable[[Any], Any]]

SEMI_MARKOV_VAGUE = Variant(
    SemiMarkov,
    "The semi-Markov Gaussian sum with one vague prior for all flights: manoeuvres twice as often as in training, of "
    "any length, disturbed, and measurements that may be outliers.",
    prior=VAGUE,
)
SEMI_MARKOV_VAGUE_DATA_ASSOCIATION = Variant(
    SemiMarkovDataAssociation,
    "`semi-markov-vague`, each of whose hypotheses weighs all plots of a scan; without clutter it is that filter.",
    prior=VAGUE,
)
FEW = {
    f"semi-markov-{H}": Variant(
        SemiMarkov, f"`semi-markov` with {H} hypotheses in place of 32.", prior=training_prior(H)
    )
    for H in (3, 5, 9, 15)
}

ESTIMATORS: dict[str, Any] = {
    "kalman-imm": KalmanInteractingMultipleModel,
    "kalman-imm-turn": KalmanTurnInteractingMultipleModel,
    "semi-markov": SemiMarkov,
    **FEW,
    "semi-markov-wide": Variant(
        SemiMarkov,
        "`semi-markov` with a prior that includes harder manoeuvres than those of training: 40 hypotheses.",
        prior=WIDE,
    ),
    "semi-markov-vague": SEMI_MARKOV_VAGUE,
    "kalman-pda": ProbabilisticDataAssociation,
    "kalman-imm-pda": InteractingMultipleModelDataAssociation,
    "semi-markov-pda": SemiMarkovDataAssociation,
    "semi-markov-vague-pda": SEMI_MARKOV_VAGUE_DATA_ASSOCIATION,
    "unscented-turn": UnscentedTurn,
    "sage-husa": SageHusaProcessNoise,
    "variational-bayes": VariationalBayes,
}


def _imm(make: Callable[..., Any]) -> Callable[[Mapping[str, float]], Settings]:
    def apply(values: Mapping[str, float]) -> Settings:
        accelerations = values["acceleration_quiet"], values["acceleration_noisy"]
        stay = values["stay_quiet"], values["stay_noisy"]
        return {}, lambda task: make(task, accelerations, stay)

    return apply


def _imm_turn(values: Mapping[str, float]) -> Settings:
    v = without_logarithms(values)
    modes = ("quiet", "noisy", "turn")
    return {}, lambda task: KalmanTurnInteractingMultipleModel(
        task,
        [v[f"acceleration_{mode}"] for mode in modes],
        v["turn_rate_start"],
        v["turn_rate_change"],
        [1.0 - v[f"leave_{mode}"] for mode in modes],
    )


TURNS: dict[int, dict[str, tuple[float, float]]] = {
    0: {},
    1: {"turn": (0.5, 7.0)},
    2: {"turn_gentle": (0.5, 3.0), "turn_steep": (3.0, 7.0)},
}
"""Limits of the mean acceleration, one for each kind of turn."""


def _semi_markov(make: Callable[..., Any], prior: SemiMarkovPrior, likelihood: bool = False) -> Tunable:
    names = TURNS[len(prior.turns)]

    def apply(values: Mapping[str, float]) -> Settings:
        v = without_logarithms(values)
        turns, leave = tuple(v.pop(name) for name in names), v.pop("leave")
        return {}, functools.partial(make, turns=turns, hazards=(*prior.hazards[:-1], leave), **v)

    of_turns = {
        "turning": (0.1, prior.turning, 0.9),
        **{
            name: (low, mean, high)
            for (name, (low, high)), mean in zip(names.items(), prior.turns, strict=True)
        },
        "turn_spread": (0.3, prior.turn_spread, 2.0),
    }
    found = tunable(
        make,
        apply,
        log10_begin=(-3.0, log10(prior.begin), -1.0),
        log10_leave=(-1.5, log10(prior.hazards[-1]), -0.3),
        log10_thrust=(0.0, log10(prior.thrust), 1.0),
        **(of_turns if names else {}),
        log10_noise=(-3.0, log10(prior.noise), 0.0),
        log10_change=(-3.0, log10(prior.change), 0.0),
    )
    return dataclasses.replace(found, likelihood=likelihood)


_IMM = {
    "acceleration_quiet": (0.0, 0.0, 0.5),
    "acceleration_noisy": (0.5, 2.775, 10.0),
    "stay_quiet": (0.8, 0.9, 0.999),
    "stay_noisy": (0.5, 0.9, 0.999),
}
_TURN_RATES = {
    "log10_turn_rate_start": (-1.0, log10(2.0), 0.7),
    "log10_turn_rate_change": (-1.5, log10(0.3), 0.3),
}

_UNITS = {
    **dict.fromkeys(("turn_rate_start", "turn_rate_change"), "degrees/s"),
    **dict.fromkeys(("leave", "leave_quiet", "leave_noisy", "leave_turn"), "probability from scan to scan"),
    **dict.fromkeys(("stay_quiet", "stay_noisy"), "probability from scan to scan"),
    **dict.fromkeys(
        ("acceleration", "acceleration_quiet", "acceleration_noisy", "acceleration_turn"), "m/s^2"
    ),
    **dict.fromkeys(("turn", "turn_gentle", "turn_steep"), "mean acceleration, m/s^2"),
}

_TUNABLE = {
    "kalman-imm": tunable(KalmanInteractingMultipleModel, _imm(KalmanInteractingMultipleModel), **_IMM),
    "kalman-pda": tunable(ProbabilisticDataAssociation, log10_acceleration=(-1.5, log10(3.0), 1.0)),
    "kalman-imm-pda": tunable(
        InteractingMultipleModelDataAssociation, _imm(InteractingMultipleModelDataAssociation), **_IMM
    ),
    "kalman-imm-turn": tunable(
        KalmanTurnInteractingMultipleModel,
        _imm_turn,
        log10_acceleration_quiet=(-3.0, log10(0.05), -0.5),
        log10_acceleration_noisy=(0.0, log10(3.0), 1.0),
        log10_acceleration_turn=(-1.0, log10(0.3), 0.5),
        **_TURN_RATES,
        log10_leave_quiet=(-3.0, log10(0.05), -1.0),
        log10_leave_noisy=(-3.0, log10(0.2), -0.5),
        log10_leave_turn=(-3.0, log10(0.2), -0.5),
    ),
    "semi-markov": _semi_markov(SemiMarkov, TRAINING),
    **{name: _semi_markov(few, few.keywords["prior"], likelihood=True) for name, few in FEW.items()},
    "semi-markov-pda": _semi_markov(SemiMarkovDataAssociation, TRAINING),
    "semi-markov-vague": _semi_markov(SEMI_MARKOV_VAGUE, VAGUE),
    "semi-markov-vague-pda": _semi_markov(SEMI_MARKOV_VAGUE_DATA_ASSOCIATION, VAGUE),
    "unscented-turn": tunable(UnscentedTurn, log10_acceleration=(-1.5, log10(0.3), 1.0), **_TURN_RATES),
}
TUNABLE = {name: dataclasses.replace(own, units=_UNITS) for name, own in _TUNABLE.items()}
