"""Scenarios of RadarEsmTracking: the paper's experiment, the training distribution, and held-out targets.

Windows are scan numbers, inclusive; at 0.5 s a scan they are 0.5-10, 10-30 and 30-60 s.
"""

from collections.abc import Mapping
from typing import Any

from ..contract.task import Scenario

_WINDOWS = {"early": (1, 20), "middle": (20, 60), "late": (60, 120)}

_ANY_TARGET: dict[str, Any] = {
    "emitter": "fixed",
    "initial_range": (30e3, 150e3),
    "closing_speed": (0.0, 900.0),
    "association_error": 0.2,
    "silence_start": (0.1, 0.1),
    "silence_end": (0.3, 0.3),
}
"""Common parameters of the held-out targets (ours)."""

SCENARIOS: Mapping[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            "paper",
            "The paper's experiment: 100 km, closing at 500 m/s, any class, type drawn anew each time.",
            {},
            _WINDOWS,
        ),
        Scenario(
            "fixed-type",
            "The paper's experiment with one emitter type for each target.",
            {"emitter": "fixed"},
            _WINDOWS,
        ),
        Scenario(
            "random",
            "Training distribution: any range and speed, one type each, failed associations; silences from none to "
            "long ones, a second emitter heard up to six times of ten, a change of class in a third of the episodes, "
            "coloured radar errors up to half of the white ones; in one of six none of these but silences.",
            {
                **_ANY_TARGET,
                "radar_bearing_sigma": 1.5,
                "silence_start": (0.0, 0.5),
                "silence_end": (0.05, 1.0),
                "second_emitter_probability": (0.0, 0.6),
                "class_change": (5.0, 55.0),
                "class_change_probability": 1.0 / 3.0,
                "radar_coloured": (0.0, 0.5),
                "radar_correlation_time": (2.0, 20.0),
                "undisturbed": 1.0 / 6.0,
            },
            _WINDOWS,
            training=True,
        ),
        Scenario(
            "crowded",
            "A second emitter of another class 2 to 20 degrees away takes half of the ESM decisions.",
            {
                **_ANY_TARGET,
                "association_error": 0.1,
                "silence_start": (0.0, 0.0),
                "silence_end": (1.0, 1.0),
                "radar_bearing_sigma": 1.5,
                "second_emitter_probability": (0.5, 0.5),
                "second_emitter_separation": (2.0, 20.0),
            },
            _WINDOWS,
        ),
        Scenario(
            "silent",
            "The target radiates only in bursts, about 5 s every 30 s.",
            {**_ANY_TARGET, "silence_start": (0.4, 0.4), "silence_end": (0.08, 0.08)},
            _WINDOWS,
        ),
        Scenario(
            "class-change",
            "The class changes once between 15 and 45 s, and the emitter type with it.",
            {**_ANY_TARGET, "class_change": (15.0, 45.0)},
            _WINDOWS,
        ),
        Scenario(
            "glint",
            "One scan in ten has radar errors five times as large; no training episode has any.",
            {**_ANY_TARGET, "glint_probability": 0.1},
            _WINDOWS,
        ),
        Scenario(
            "correlated-errors",
            "White errors of range and range rate whose correlation is -0.9 to -0.5, unreported; no training episode "
            "holds any.",
            {**_ANY_TARGET, "radar_correlation": (-0.9, -0.5)},
            _WINDOWS,
        ),
    )
}
