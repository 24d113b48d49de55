"""Constants of a task of state-space models other than its models, with their limits."""

from dataclasses import dataclass

from ..contract.parameters import TaskParameters, parameter


@dataclass(frozen=True)
class StateSpaceParameters(TaskParameters):
    """Parameters of a task of state-space models, beside its models."""

    sampling_interval: float = parameter(1.0, above=0.0)
    """Time between measurements, s; the average for a timed model."""
    jitter: float = parameter(0.0, at_least=0.0, below=1.0)
    """Largest deviation of an interval of a timed model from the sampling interval, as a share of it."""
    process_noise: tuple[float, float] = parameter((1.0, 1.0), above=0.0, ascending=True)
    """Limits of the factor by which the true Q differs from the model's, drawn log-uniformly for every episode."""
    measurement_noise: tuple[float, float] = parameter((1.0, 1.0), above=0.0, ascending=True)
    """Limits of the factor by which the true R differs from the model's, drawn log-uniformly for every episode."""
    availability: float = parameter(1.0, at_least=0.0, at_most=1.0)
    """Probability that a measurement is received."""
    gaps: float = parameter(0.0, at_least=0.0, below=1.0)
    """Probability at a measurement that a gap of a sensor begins, in which it gives no values; for each sensor."""
    gap_length: float = parameter(10.0, at_least=1.0)
    """Mean length of a gap, measurements."""
    bias: float = parameter(0.0, at_least=0.0)
    """Offset of one sensor, up or down, in standard deviations of its noise."""
    late: float = parameter(0.0, at_least=0.0, below=1.0)
    """Probability that the values of a sensor are delayed, for each sensor."""
    lateness: int = parameter(3, at_least=1, at_most=20)
    """Delay of these values, measurements."""
    noise_decades: float = parameter(2.0, above=0.0)
    """Decades by which an action of one scales Q or R (control ``noise``)."""
    gain_factor: float = parameter(4.0, above=1.0)
    """Factor by which an action of one multiplies the gain of a component (control ``gain``)."""
    evidence_scale: float = parameter(2.0, above=0.0)
    """Nats that an evidence of one adds to the log-posterior (control ``evidence``)."""
