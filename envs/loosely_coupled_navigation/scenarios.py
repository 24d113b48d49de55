"""Scenarios of loosely coupled navigation. Measurement k is taken at k times 0.01 s.

Every episode has a random motion, except in ``paper``, which has the sine of the paper.

The times of disturbances are drawn for each episode: the window "during" contains the measurements that certainly lie
in the disturbance, "after" those certainly past it.
"""

from collections.abc import Mapping

from ..contract.task import Scenario

DECADE = (10**-0.5, 10**0.5)
"""Limits of a factor: a decade around the modelled value."""
DOWN_TO_QUIET = (0.05, 10**0.5)
"""Limits of a factor: a decade, extended down to half of the smallest drift of ``quiet``."""
DOWN_TO_SILENT = (0.005, 10**0.5)
"""Limits of a factor: a decade, extended down to half of the smallest intensities of ``quiet``."""

_LATE = {"late": (250, 500)}
_DRAWN = {"manoeuvres": 4}
"""Parameters of a random motion."""

SCENARIOS: Mapping[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            "paper",
            "The fusion example as printed: the same sine in every episode, noises as modelled, no disturbance.",
            {},
            _LATE,
        ),
        Scenario(
            "random",
            "Training distribution: a motion of the episode's own; "
            "drift, coloured and white noise from far less than modelled to three times it; "
            "receiver noise over a decade, with up to two changes, unreported half of the time, and a coloured error "
            "beside it; outages, jamming and spoofing in some episodes each; in one of six no hidden disturbance.",
            {
                **_DRAWN,
                "drift_factor": DOWN_TO_QUIET,
                "coloured_factor": DOWN_TO_SILENT,
                "white_factor": DOWN_TO_SILENT,
                "receiver_factor": DECADE,
                "noise_changes": (0, 2),
                "unreported": 0.5,
                "outage_probability": 0.4,
                "outage_start": (0.5, 4.0),
                "outage_duration": (0.2, 2.0),
                "jamming_probability": 0.25,
                "jamming_start": (0.5, 4.0),
                "jamming_duration": (0.2, 1.5),
                "jamming_factor": (3.0, 300.0),
                "spoofing_probability": 0.25,
                "spoofing_start": (0.5, 3.5),
                "spoofing_duration": (0.5, 2.0),
                "spoofing_rate": (-3.0, 3.0),
                "receiver_coloured": (0.0, 0.5),
                "receiver_correlation_time": (0.5, 5.0),
                "undisturbed": 1.0 / 6.0,
            },
            _LATE,
            training=True,
        ),
        Scenario(
            "outage",
            "No measurement for some 1.5 s from about 2 s on.",
            {
                **_DRAWN,
                "outage_probability": 1.0,
                "outage_start": (1.5, 2.5),
                "outage_duration": (1.25, 1.75),
            },
            {**_LATE, "during": (250, 274), "after": (426, 500)},
        ),
        Scenario(
            "jamming",
            "Receiver noise of a hundred times the intensity for some 1 s at any time, unreported.",
            {
                **_DRAWN,
                "jamming_probability": 1.0,
                "jamming_start": (0.5, 4.0),
                "jamming_duration": (0.9, 1.1),
                "jamming_factor": (100.0, 100.0),
            },
            _LATE,
        ),
        Scenario(
            "spoof-ramp",
            "The measurement is pulled off at 2 m/s for some 1.5 s at any time, then true again.",
            {
                **_DRAWN,
                "spoofing_probability": 1.0,
                "spoofing_start": (0.5, 3.5),
                "spoofing_duration": (1.25, 1.75),
                "spoofing_rate": (2.0, 2.0),
            },
            _LATE,
        ),
        Scenario(
            "quiet",
            "An INS better than modelled, by an unknown factor: down to a tenth of the drift and a hundredth of "
            "the intensities.",
            {
                **_DRAWN,
                "drift_factor": (0.1, 1.0),
                "coloured_factor": (0.01, 1.0),
                "white_factor": (0.01, 1.0),
            },
            _LATE,
        ),
        Scenario(
            "outliers",
            "Every twentieth fix on average has ten times the noise; no training episode holds any.",
            {**_DRAWN, "outlier_probability": 0.05},
            _LATE,
        ),
        Scenario(
            "coloured-receiver",
            "Fixes with a coloured error of 0.6 to 1.2 m that lasts for 5 to 20 s beside the white one, unreported: "
            "more, and longer, than in any training episode, and in 5 s hardly distinguishable from a bias.",
            {
                **_DRAWN,
                "receiver_coloured": (0.6, 1.2),
                "receiver_correlation_time": (5.0, 20.0),
            },
            _LATE,
        ),
    )
}
