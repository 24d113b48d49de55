"""Scenarios of ManeuveringTarget: the paper's flight, the training distribution, and held-out flights.

Windows are scan numbers, first and last included. The flights of ``atc``, ``cruise`` and ``descent`` are legs that no
training episode contains: duration straight or turning (s) and turn rate (deg/s, anticlockwise positive), flown
exactly. Start, direction, side and durations are drawn for each episode around the stated ones. ``paper`` is always
the same flight. In ``missed-detections`` and ``irregular-scans`` the flights are those of training, and the radar has
one fault of a stated strength; so in ``glint``, ``biased`` and ``clutter``, whose faults no training episode contains.
"""

from collections.abc import Mapping

from ..contract.task import Scenario

_AROUND = {"start_spread": 5e3, "course_spread": 30.0, "mirrored": 0.5, "leg_spread": 0.5}

SCENARIOS: Mapping[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            "paper",
            "The paper's flight: straight at 100 m/s, one 90-degree turn at scans 50 to 55, straight again. It is "
            "always the same and can be memorised.",
            {"flight": "maneuver"},
            {
                "pre": (30, 49),
                "turn": (50, 55),
                "recovery": (56, 62),
                "post": (70, 100),
            },
        ),
        Scenario(
            "random",
            "Training distribution: any start, speed and course; up to three manoeuvres of any kind; scans miss "
            "the target, from hardly ever to four of ten, and come early; in half of the episodes coloured errors of "
            "up to half the deviation of the white ones are added to these.",
            {
                "flight": "random",
                "detection_probability": (0.6, 1.0),
                "scan_jitter": (0.0, 0.95),
                "coloured_sigma": (0.0, 0.5),
                "undisturbed": 0.5,
            },
            {"start": (1, 10), "settled": (11, 100)},
            training=True,
        ),
        Scenario(
            "atc",
            "An airliner in approach control: a long gentle turn, then a short steep one.",
            {
                "flight": "legs",
                "sampling_interval": 5.0,
                "horizon": 98,
                "initial_position": (25e3, 10e3),
                "initial_velocity": (-120.0, 0.0),
                "legs": ((125.0, 0.0), (90.0, 1.0), (125.0, 0.0), (30.0, -3.0), (125.0, 0.0)),
                **_AROUND,
            },
            {"start": (1, 10), "settled": (11, 98)},
        ),
        Scenario(
            "cruise",
            "A fast airliner: straight but for one gentle turn of a third of g.",
            {
                "flight": "legs",
                "sampling_interval": 5.0,
                "horizon": 60,
                "initial_position": (30e3, 30e3),
                "initial_velocity": (-172.0, -246.0),
                "legs": ((120.0, 0.0), (60.0, 0.7), (120.0, 0.0)),
                **_AROUND,
            },
            {"start": (1, 10), "settled": (11, 60)},
        ),
        Scenario(
            "descent",
            "An airliner at half the speed: a turn of a quarter of g, later a short one to the other side.",
            {
                "flight": "legs",
                "sampling_interval": 5.0,
                "horizon": 80,
                "initial_position": (30e3, 30e3),
                "initial_velocity": (-90.0, -120.0),
                "legs": ((100.0, 0.0), (60.0, 1.0), (150.0, 0.0), (20.0, -1.5), (100.0, 0.0)),
                **_AROUND,
            },
            {"start": (1, 10), "settled": (11, 80)},
        ),
        Scenario(
            "missed-detections",
            "Flights as in random; a scan sees the target with probability 0.7 only.",
            {"flight": "random", "detection_probability": (0.7, 0.7)},
            {"start": (1, 10), "settled": (11, 100)},
        ),
        Scenario(
            "irregular-scans",
            "Flights as in random; scans come early by up to 0.8 of the scan period: intervals of 1.2 to 10.8 s.",
            {"flight": "random", "scan_jitter": (0.8, 0.8)},
            {"start": (1, 10), "settled": (11, 100)},
        ),
        Scenario(
            "glint",
            "Flights as in random, every scan on time; one scan in ten has errors five times as large. No training "
            "episode holds any.",
            {"flight": "random", "glint_probability": 0.1},
            {"start": (1, 10), "settled": (11, 100)},
        ),
        Scenario(
            "biased",
            "Flights as in random, every scan on time; a radar that is not aligned: constant errors along x and y of "
            "up to one white sigma each. No training episode holds any.",
            {"flight": "random", "bias": 1.0},
            {"start": (1, 10), "settled": (11, 100)},
        ),
        Scenario(
            "clutter",
            "Flights as in random, every scan on time; scans miss the target now and then, and show false plots beside "
            "it: 0.2 to 1.8 on average in the window of 6 km by 6 km about the track. No training episode holds any.",
            {
                "flight": "random",
                "detection_probability": (0.8, 0.95),
                "clutter_density": (0.005, 0.05),
            },
            {"start": (1, 10), "settled": (11, 100)},
        ),
    )
}
