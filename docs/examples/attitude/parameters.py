"""Every constant of the problem, with its limits and where it comes from."""

from dataclasses import dataclass

from filtergym.envs.contract.parameters import TaskParameters, parameter


@dataclass(frozen=True)
class AttitudeParameters(TaskParameters):
    """Every constant of the task; each is a keyword of ``gym.make``.

    Ranges are ours: wider than hand movements and cheap sensors of the kind that BROAD recorded. Its rate is BROAD's.
    """

    horizon: int = parameter(20_000, at_least=1)
    """Measurements acted on in one episode: 70 s."""
    decision_interval: int = parameter(40, at_least=1)
    """Measurements for which one action holds: 0.14 s."""
    sampling_interval: float = parameter(0.0035, above=0.0)
    """T, s (BROAD: 2000 / 7 Hz)."""
    rate_levels: tuple[float, float] = parameter((5.0, 300.0), above=0.0, ascending=True)
    """Limits of the root mean square of the angular rate about each axis while the sensor moves, deg/s, log-uniform."""
    rate_frequencies: tuple[float, float] = parameter((0.1, 1.5), above=0.0, ascending=True)
    """Limits of the frequency of rotations, Hz, log-uniform."""
    acceleration_levels: tuple[float, float] = parameter((0.1, 20.0), above=0.0, ascending=True)
    """Limits of the root mean square of the acceleration along each axis, m/s^2, log-uniform."""
    acceleration_frequencies: tuple[float, float] = parameter((0.5, 4.0), above=0.0, ascending=True)
    """Limits of the frequency of accelerations, Hz, log-uniform."""
    break_probability: float = parameter(0.5, at_least=0.0, at_most=1.0)
    """That the sensor rests now and then."""
    break_periods: tuple[float, float] = parameter((4.0, 20.0), above=0.0, ascending=True)
    """Limits of the time from one break to the next, s."""
    break_shares: tuple[float, float] = parameter((0.1, 0.6), above=0.0, below=1.0, ascending=True)
    """Limits of the share of time that breaks take."""
    first_rests: tuple[float, float] = parameter((0.0, 20.0), at_least=0.0, ascending=True)
    """Limits of the time that the sensor rests first, s."""
    field_strengths: tuple[float, float] = parameter((25.0, 65.0), above=0.0, ascending=True)
    """Limits of the magnetic field, microtesla (on the surface of the Earth)."""
    dips: tuple[float, float] = parameter((30.0, 80.0), at_least=0.0, below=90.0, ascending=True)
    """Limits of its angle below the horizon, deg."""
    field_levels: tuple[float, float] = parameter((0.3, 15.0), above=0.0, ascending=True)
    """Limits of the root mean square of what iron in a room adds to each axis of the field, microtesla, log-uniform,
    drawn for the time before and after a change."""
    field_times: tuple[float, float] = parameter((0.3, 5.0), above=0.0, ascending=True)
    """Limits of the time constant in which that changes while the sensor moves, s, log-uniform."""
    magnet_probability: float = parameter(0.2, at_least=0.0, at_most=1.0)
    """That a magnet is fixed to the sensor."""
    magnet_levels: tuple[float, float] = parameter((2.0, 15.0), above=0.0, ascending=True)
    """Limits of the root mean square of what it adds to each axis, microtesla, log-uniform."""
    gyroscope_bias: float = parameter(0.3, at_least=0.0)
    """Standard deviation of the constant error of each gyroscope, deg/s."""
    gyroscope_scale: float = parameter(0.005, at_least=0.0)
    """Standard deviation of its relative error."""
    gyroscope_sigma: float = parameter(0.1, above=0.0)
    """Standard deviation of its white error, deg/s."""
    accelerometer_bias: float = parameter(0.05, at_least=0.0)
    """Standard deviation of the constant error of each accelerometer, m/s^2."""
    accelerometer_sigma: float = parameter(0.05, above=0.0)
    """Standard deviation of its white error, m/s^2."""
    magnetometer_sigma: float = parameter(0.7, above=0.0)
    """Standard deviation of the white error of each magnetometer, microtesla."""
    initial_tilt: float = parameter(1.0, at_least=0.0)
    """Standard deviation of the initial estimate about each horizontal axis, deg."""
    initial_heading: float = parameter(5.0, at_least=0.0)
    """Standard deviation of its heading, deg."""
    stated_sigma: float = parameter(3.0, above=0.0)
    """Standard deviation that every filter states for its attitude about each axis, deg: none has a covariance of its
    own."""
    gain_decades: float = parameter(1.5, above=0.0)
    """Decades by which an action of one scales a gain or a time constant."""
    integral_gain: float = parameter(0.05, at_least=0.0)
    """Integral gain of Mahony's filter at an action of one, 1/s^2; zero below an action of zero."""
