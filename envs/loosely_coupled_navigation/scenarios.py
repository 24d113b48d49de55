"""Scenarios of loosely coupled navigation. Measurement k is taken at k times 0.01 s."""

from collections.abc import Mapping

from ..task import Scenario

DECADE = (10**-0.5, 10**0.5)
"""A decade around the modelled value."""

_LATE = {"late": (250, 500)}

SCENARIOS: Mapping[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario("paper", "The fusion example: noises as modelled, no disturbance.", {}, _LATE),
        Scenario(
            "random",
            "Drift, coloured, white and receiver noise over a decade each; the receiver noise changes once "
            "or twice, unreported half of the time; outages.",
            {
                "drift_factor": DECADE,
                "coloured_factor": DECADE,
                "white_factor": DECADE,
                "receiver_factor": DECADE,
                "noise_changes": (1, 2),
                "unreported": 0.5,
                "outage_probability": 0.5,
                "outage_start": (0.5, 4.0),
                "outage_duration": (0.2, 1.0),
            },
            _LATE,
            training=True,
        ),
        Scenario(
            "outage",
            "No measurement from 2.0 to 3.5 s.",
            {"outage_probability": 1.0, "outage_start": (2.0, 2.0), "outage_duration": (1.5, 1.5)},
            {**_LATE, "during": (200, 349), "after": (350, 500)},
        ),
        Scenario(
            "jamming",
            "Receiver noise of a hundred times the intensity from 2.0 to 3.0 s, unreported.",
            {
                "jamming_probability": 1.0,
                "jamming_start": (2.0, 2.0),
                "jamming_duration": (1.0, 1.0),
                "jamming_factor": 100.0,
            },
            {**_LATE, "during": (200, 299), "after": (300, 500)},
        ),
        Scenario(
            "spoof-ramp",
            "The measurement is pulled off at 2 m/s from 2.0 to 3.5 s, then true again.",
            {
                "spoofing_probability": 1.0,
                "spoofing_start": (2.0, 2.0),
                "spoofing_duration": (1.5, 1.5),
                "spoofing_rate": 2.0,
            },
            {**_LATE, "during": (200, 349), "after": (350, 500)},
        ),
        Scenario(
            "quiet",
            "An INS much better than modelled: a tenth of the drift, a hundredth of the intensities.",
            {
                "drift_factor": (0.1, 0.1),
                "coloured_factor": (0.01, 0.01),
                "white_factor": (0.01, 0.01),
            },
            _LATE,
        ),
    )
}
