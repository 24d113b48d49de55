"""Scenarios of tightly coupled navigation."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from ..contract.task import Scenario

WINDOWS = MappingProxyType({"leg1": (200, 999), "leg2": (1100, 1999), "leg3": (2100, 3000)})
"""Windows of measurements: the steady parts of the three legs of the paper's experiment."""
RANDOM_WINDOWS = MappingProxyType({"settled": (100, 600)})

EXPERIMENT: Mapping[str, Any] = MappingProxyType(
    {
        "horizon": 3000,
        "decision_interval": 1,
        "increment_sigma": 0.3,
        "rate_fault_probability": 0.0,
        "stick_probability": 0.0,
        "aperture": True,
        "heading": (45.0, 45.0),
    }
)
"""The paper's experiment: no faults, tracking loops steered by the filter; one course, the same in every episode."""

HEALTHY: Mapping[str, Any] = MappingProxyType({"rate_fault_probability": 0.0, "stick_probability": 0.0})

SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        scenario.name: scenario
        for scenario in (
            Scenario(
                "paper",
                "Rest, velocity growing by 0.3 m/s per step while the accelerometers show nothing (stuck at "
                "zero), then a jump to 30 m/s^2 and Singer flight; 3000 steps.",
                {**EXPERIMENT, "course": "increment"},
                WINDOWS,
            ),
            Scenario(
                "kinematic",
                "As paper, with an acceleration of 30 m/s^2 in leg 2 that the accelerometers feel and that "
                "turns by 90 degrees at its end.",
                {**EXPERIMENT, "course": "kinematic"},
                WINDOWS,
            ),
            Scenario(
                "matched",
                "Singer flight throughout: what the parallel hypotheses cost when one of them is right.",
                {**EXPERIMENT, "course": "matched", "aperture": False},
                WINDOWS,
            ),
            Scenario(
                "random",
                "Training distribution: legs of rest, constant velocity and manoeuvre at random, or one manoeuvre "
                "throughout, gentle to hard; a noisy rate channel, stuck accelerometers, lost rates or hidden "
                "satellites for a while, reception between houses, tracking loops steered by the filter, each in some "
                "episodes, and coloured errors of pseudoranges; in one of six no hidden disturbance.",
                {
                    "strength": (0.5, 40.0),
                    "manoeuvre_throughout": 0.15,
                    "rate_fault_probability": 0.3,
                    "rate_fault_factor": (2.0, 10.0),
                    "stick_probability": 0.3,
                    "stick_duration": (0.3, 4.5),
                    "rates_outage_probability": 0.15,
                    "rates_outage_duration": (0.1, 2.5),
                    "satellites_outage_probability": 0.2,
                    "satellites_outage_duration": (0.1, 3.0),
                    "urban": True,
                    "urban_probability": 0.15,
                    "urban_speed": 0.05,
                    "urban_strength": 0.1,
                    "aperture": True,
                    "aperture_probability": 0.2,
                    "undisturbed": 1.0 / 6.0,
                    "pseudorange_coloured": (0.0, 2.0),
                    "pseudorange_correlation_time": (1.0, 20.0),
                },
                RANDOM_WINDOWS,
                training=True,
            ),
            Scenario(
                "rates-lost",
                "Legs as in random, without faults; all pseudorange rates are lost for 2 s.",
                {**HEALTHY, "rates_outage_probability": 1.0},
                RANDOM_WINDOWS,
            ),
            Scenario(
                "two-satellites",
                "Legs as in random, without faults; two of the satellites drop out for 2 s.",
                {**HEALTHY, "satellites_outage_probability": 1.0},
                RANDOM_WINDOWS,
            ),
            Scenario(
                "accelerometer-failure",
                "Legs as in random; the accelerometers stick at their last reading for 2 to 4 s.",
                {"rate_fault_probability": 0.0, "stick_probability": 1.0, "stick_duration": (2.0, 4.0)},
                RANDOM_WINDOWS,
            ),
            Scenario(
                "urban",
                "A vehicle between houses: slow, gentle; pseudoranges with positive heavy-tailed errors by "
                "C/N0.",
                {**HEALTHY, "urban": True, "strength": (0.5, 4.0), "initial_speed": (0.0, 15.0)},
                RANDOM_WINDOWS,
            ),
            Scenario(
                "satellite-ramp",
                "Legs as in random, without faults; one satellite's pseudorange drifts off at 10 m/s, from a time "
                "between 1 and 3 s to the end. No training episode holds any.",
                {**HEALTHY, "ramp_probability": 1.0},
                RANDOM_WINDOWS,
            ),
            Scenario(
                "satellite-bias",
                "Legs as in random, without faults; one satellite's pseudorange is off by 10 to 50 m, from a time "
                "between 1 and 3 s to the end. No training episode holds any.",
                {**HEALTHY, "ramp_probability": 1.0, "ramp_rate": 0.0, "ramp_jump": (10.0, 50.0)},
                RANDOM_WINDOWS,
            ),
            Scenario(
                "coloured-ranges",
                "Legs as in random, without faults; every pseudorange has a coloured error of 3 to 8 m that lasts for "
                "1 to 20 s, larger than any in training.",
                {
                    **HEALTHY,
                    "pseudorange_coloured": (3.0, 8.0),
                    "pseudorange_correlation_time": (1.0, 20.0),
                },
                RANDOM_WINDOWS,
            ),
        )
    }
)
"""Scenarios by name."""
