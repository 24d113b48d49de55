"""Scenarios of ManeuveringTarget: the paper's flight, the training distribution, and held-out flights.

Windows are scan numbers, first and last included. The flights of ``atc`` and the two ``benchmark`` scenarios
are fixed legs that no training episode contains: time straight or turning (s) and turn rate (deg/s,
anticlockwise positive), flown exactly.
"""

from collections.abc import Mapping

from ..task import Scenario

SCENARIOS: Mapping[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            "paper",
            "The paper's flight: straight at 100 m/s, one 90-degree turn at scans 50 to 55, straight again.",
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
            "Training distribution: any start, speed and course; up to three manoeuvres of any kind.",
            {"flight": "random"},
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
            },
            {
                "straight-1": (11, 25),
                "slow-turn": (26, 43),
                "straight-2": (49, 68),
                "fast-turn": (69, 74),
                "straight-3": (80, 98),
            },
        ),
        Scenario(
            "benchmark-s1",
            "A fast aircraft turning at 3.74 deg/s (about 2 g) from 61 s to 106 s.",
            {
                "flight": "legs",
                "sampling_interval": 5.0,
                "horizon": 30,
                "initial_position": (30e3, 30e3),
                "initial_velocity": (-172.0, -246.0),
                "legs": ((61.0, 0.0), (45.0, 3.74), (44.0, 0.0)),
            },
            {"straight-1": (6, 12), "turn": (13, 21), "straight-2": (25, 30)},
        ),
        Scenario(
            "benchmark-s2",
            "A fast aircraft turning at 4.68 deg/s (about 2.5 g) from 61 s to 96 s, seen from further off.",
            {
                "flight": "legs",
                "sampling_interval": 5.0,
                "horizon": 30,
                "initial_position": (20e3, 50e3),
                "initial_velocity": (-172.0, -246.0),
                "legs": ((61.0, 0.0), (35.0, 4.68), (54.0, 0.0)),
            },
            {"straight-1": (6, 12), "turn": (13, 19), "straight-2": (23, 30)},
        ),
    )
}
