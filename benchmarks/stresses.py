"""Stresses: flights outside the training distribution, with parameters beyond their training range, alone and in pairs.

Each consists of ``usual``, legs or targets of any kind under a scenario without faults, and the keywords of the stress.
A test compares every one with the training distribution: at least one of its parameters lies outside it.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple


class Stresses(NamedTuple):
    """Stresses of one environment: parameters outside its training, by name of the stress."""

    scenario: str
    """Scenario without faults."""
    usual: Mapping[str, Any]
    """Parameters of all stresses."""
    each: Mapping[str, Mapping[str, Any]]
    """Parameters of each, by its name."""


STRESSES: Mapping[str, Stresses] = {
    "filtergym/ManeuveringTarget-v0": Stresses(
        "paper",
        {"flight": "random"},
        {
            "few-detections": {"detection_probability": (0.35, 0.5)},
            "slow-target": {"speed": (20.0, 40.0)},
            "fast-target": {"speed": (400.0, 600.0)},
            "far-target": {"start_range": (90e3, 120e3)},
            "hard-manoeuvres": {"maneuver_count": (1, 3), "maneuver_acceleration": (8.0, 12.0)},
            "long-manoeuvres": {"maneuver_count": (1, 2), "maneuver_duration": (20, 30)},
            "many-manoeuvres": {"maneuver_count": (5, 7), "maneuver_duration": (3, 6)},
            "coloured-errors": {"coloured_sigma": (0.8, 1.2)},
            "lasting-errors": {"coloured_sigma": (0.5, 0.5), "coloured_time": (120.0, 300.0)},
            "rare-large-glint": {"glint_probability": 0.03, "glint_factor": 10.0},
            "frequent-small-glint": {"glint_probability": 0.2, "glint_factor": 3.0},
            "large-bias": {"bias": 2.0},
            "polar-errors": {"polar_measurements": True},
            "slow-scans": {"sampling_interval": 12.0},
            "glint-and-few-detections": {
                "glint_probability": 0.1,
                "detection_probability": (0.35, 0.5),
            },
            "hard-manoeuvres-and-coloured-errors": {
                "maneuver_count": (1, 3),
                "maneuver_acceleration": (8.0, 12.0),
                "coloured_sigma": (0.8, 1.2),
            },
        },
    ),
    "filtergym/LooselyCoupledNavigation-v0": Stresses(
        "paper",
        {"manoeuvres": 4},
        {
            "noisy-receiver": {"receiver_factor": (5.0, 10.0)},
            "quiet-receiver": {"receiver_factor": (0.05, 0.2)},
            "large-drift": {"drift_factor": (5.0, 8.0)},
            "large-coloured-rate-error": {"coloured_factor": (5.0, 10.0)},
            "large-white-rate-error": {"white_factor": (5.0, 10.0)},
            "long-outage": {
                "outage_probability": 1.0,
                "outage_start": (0.5, 1.5),
                "outage_duration": (2.5, 3.5),
            },
            "long-jamming": {
                "jamming_probability": 1.0,
                "jamming_start": (0.5, 1.5),
                "jamming_duration": (2.5, 3.5),
                "jamming_factor": (5.0, 30.0),
            },
            "fast-spoofing": {"spoofing_probability": 1.0, "spoofing_rate": (5.0, 8.0)},
            "long-spoofing": {
                "spoofing_probability": 1.0,
                "spoofing_start": (0.5, 1.0),
                "spoofing_duration": (3.0, 3.5),
                "spoofing_rate": (0.5, 1.0),
            },
            "frequent-small-outliers": {"outlier_probability": 0.2, "outlier_factor": 9.0},
            "rare-large-outliers": {"outlier_probability": 0.01, "outlier_factor": 1e4},
            "coloured-receiver-short": {
                "receiver_coloured": (1.0, 2.0),
                "receiver_correlation_time": (0.5, 5.0),
            },
            "outliers-and-large-drift": {"outlier_probability": 0.05, "drift_factor": (5.0, 8.0)},
            "long-outage-and-large-coloured-rate-error": {
                "outage_probability": 1.0,
                "outage_start": (0.5, 1.5),
                "outage_duration": (2.5, 3.5),
                "coloured_factor": (5.0, 10.0),
            },
        },
    ),
    "filtergym/UavAutopilot-v0": Stresses(
        "paper-noise",
        {"command_amplitude": (0.25, 1.0)},
        {
            "storm": {"disturbance_levels": ((7.0, 10.0),)},
            "calm": {"disturbance_levels": ((0.05, 0.1),)},
            "noisy-sensors": {"sensor_levels": ((8.0, 12.0),)},
            "quiet-sensors": {"sensor_levels": ((0.2, 0.35),)},
            "coloured-sensors": {"sensor_coloured": (0.6, 1.2)},
            "lasting-sensor-errors": {
                "sensor_coloured": (0.3, 0.3),
                "sensor_correlation_time": (10.0, 30.0),
            },
            "pitch-bias": {"sensor_bias": (1.0, 2.0), "biased_sensors": ("pitch",)},
            "all-biased": {"sensor_bias": (0.5, 1.5)},
            "long-dropouts": {"dropout_period": 300, "dropout_length": (40, 80)},
            "frequent-dropouts": {"dropout_period": 50, "dropout_length": (1, 15)},
            "very-slow-actuator": {"actuator_lag": 3.0},
            "quick-actuator": {"actuator_lag": 0.5},
            "large-commands": {"command_amplitude": (3.0, 6.0)},
            "slow-actuator-in-storm": {"actuator_lag": 2.0, "disturbance_levels": ((7.0, 10.0),)},
            "biased-and-noisy-sensors": {"sensor_bias": (1.0, 2.0), "sensor_levels": ((8.0, 12.0),)},
        },
    ),
    "filtergym/RadarEsmTracking-v0": Stresses(
        "paper",
        {
            "emitter": "fixed",
            "initial_range": (30e3, 150e3),
            "closing_speed": (0.0, 900.0),
            "association_error": 0.2,
            "radar_bearing_sigma": 1.5,
        },
        {
            "far-target": {"initial_range": (250e3, 400e3)},
            "fast-target": {"closing_speed": (1200.0, 1800.0)},
            "receding-target": {"closing_speed": (-900.0, -300.0)},
            "rare-large-glint": {"glint_probability": 0.03, "glint_factor": 10.0},
            "frequent-small-glint": {"glint_probability": 0.2, "glint_factor": 3.0},
            "positive-correlation": {"radar_correlation": (0.5, 0.9)},
            "coloured-errors": {"radar_coloured": (0.8, 1.2), "radar_correlation_time": (2.0, 20.0)},
            "lasting-errors": {"radar_coloured": (0.5, 0.5), "radar_correlation_time": (40.0, 80.0)},
            "very-crowded": {"second_emitter_probability": (0.8, 0.95)},
            "long-silence": {"silence_start": (0.7, 0.9), "silence_end": (0.01, 0.04)},
            "early-change": {"class_change": (1.0, 4.0)},
            "glint-and-crowd": {"glint_probability": 0.1, "second_emitter_probability": (0.8, 0.95)},
            "coloured-errors-and-change": {
                "radar_coloured": (0.8, 1.2),
                "radar_correlation_time": (2.0, 20.0),
                "class_change": (15.0, 45.0),
            },
        },
    ),
    "filtergym/TightlyCoupledNavigation-v0": Stresses(
        "two-satellites",
        {"satellites_outage_probability": 0.0},
        {
            "very-noisy-rate": {"rate_fault_probability": 1.0, "rate_fault_factor": (20.0, 40.0)},
            "long-noisy-rate": {
                "rate_fault_probability": 1.0,
                "rate_fault_factor": (5.0, 10.0),
                "rate_fault_duration": (4.0, 5.0),
            },
            "long-stick": {"stick_probability": 1.0, "stick_duration": (4.8, 5.5)},
            "long-rates-outage": {
                "rates_outage_probability": 1.0,
                "rates_outage_duration": (3.5, 4.5),
            },
            "long-satellites-outage": {
                "satellites_outage_probability": 1.0,
                "satellites_outage_duration": (4.0, 5.0),
            },
            "violent-manoeuvres": {"strength": (60.0, 90.0)},
            "fast-vehicle": {"initial_speed": (500.0, 800.0), "rest_probability": 0.0},
            "slow-ramp": {"ramp_probability": 1.0, "ramp_rate": 3.0},
            "fast-ramp": {"ramp_probability": 1.0, "ramp_rate": 40.0},
            "very-coloured-ranges": {
                "pseudorange_coloured": (8.0, 15.0),
                "pseudorange_correlation_time": (1.0, 20.0),
            },
            "lasting-range-errors": {
                "pseudorange_coloured": (2.0, 2.0),
                "pseudorange_correlation_time": (40.0, 80.0),
            },
            "stick-and-ramp": {
                "stick_probability": 1.0,
                "stick_duration": (2.0, 4.0),
                "ramp_probability": 1.0,
            },
            "violent-manoeuvres-and-noisy-rate": {
                "strength": (60.0, 90.0),
                "rate_fault_probability": 1.0,
                "rate_fault_factor": (20.0, 40.0),
            },
        },
    ),
}
"""Stresses by Gymnasium id."""
