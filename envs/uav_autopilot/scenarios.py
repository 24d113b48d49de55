"""Scenarios of UavAutopilot: the paper's two inputs, the training distribution, and four held-out tests.

Times and lengths are counted in measurements, so that one table serves both plants: the loops settle in 16 (plant P)
and 27 (plant U) of them. Levels multiply the nominal standard deviations. The window "steady" of ``paper-noise`` stops
before the end: the filter is optimal for an infinite horizon, and in the last measurements control costs without a
later benefit.
"""

from collections.abc import Mapping

from ..contract.task import Scenario

_RANDOM = {
    "command_amplitude": (0.25, 1.0),
    "disturbance_levels": ((0.2, 5.0), (0.2, 5.0), (0.2, 5.0)),
    "disturbance_times": ((100, 250), (350, 500)),
    "sensor_levels": ((0.5, 6.0), (0.5, 6.0)),
    "sensor_times": ((150, 450),),
    "sensor_coloured": (0.0, 0.3),
    "dropout_period": 300,
    "undisturbed": 1.0 / 6.0,
}
_NOMINAL_WITH_COMMANDS = {"command_amplitude": (0.25, 1.0)}

SCENARIOS: Mapping[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            "paper-noise",
            "White noise only, nominal and known: the filter is optimal and the loop stationary.",
            {},
            {"steady": (200, 550)},
        ),
        Scenario(
            "paper-step",
            "A unit step of the command added to the white noise.",
            {"step_size": 1.0, "step_time": 200},
            {"before": (100, 199), "transient": (200, 299), "steady": (300, 600)},
        ),
        Scenario(
            "random",
            "Training distribution: steps and doublets of the command; gust level and sensor noise drawn for each "
            "episode and changing inside it, coloured errors of the sensors besides the white ones; short dropouts of "
            "single sensors; in one of six all noise is white and nominal.",
            _RANDOM,
            {"steady": (50, 600)},
            training=True,
        ),
        Scenario(
            "gust-front",
            "Gusts go from light to severe (four times) at one measurement, drawn from 150 to 350, unreported.",
            {
                **_NOMINAL_WITH_COMMANDS,
                "disturbance_levels": ((1.0, 1.0), (4.0, 4.0)),
                "disturbance_times": ((150, 350),),
            },
            {"before": (50, 149), "front": (150, 350), "after": (351, 600)},
        ),
        Scenario(
            "sensor-degradation",
            "The noise of the rate sensor grows fivefold at one measurement, drawn from 150 to 350, unreported.",
            {
                **_NOMINAL_WITH_COMMANDS,
                "sensor_levels": ((1.0, 1.0), (5.0, 5.0)),
                "sensor_times": ((150, 350),),
                "changing_sensors": ("rate",),
            },
            {"before": (50, 149), "after": (351, 600)},
        ),
        Scenario(
            "actuator-lag",
            "The actuator is twice as slow as in the model of filter and autopilot (plant U); no training episode "
            "holds the like.",
            {**_NOMINAL_WITH_COMMANDS, "actuator_lag": 2.0},
            {"steady": (100, 600)},
        ),
        Scenario(
            "gyro-bias",
            "The rate sensor has a constant error of one to two nominal standard deviations, unreported; no training "
            "episode holds the like.",
            {**_NOMINAL_WITH_COMMANDS, "sensor_bias": (1.0, 2.0), "biased_sensors": ("rate",)},
            {"steady": (100, 600)},
        ),
    )
}
