"""Constants of ManeuveringTarget with their limits."""

from dataclasses import dataclass

from ..contract.parameters import TaskParameters, check_length, parameter, square_matrix

PLOT_SLOTS = 12
"""Largest number of plots of a scan, where there is clutter."""
MOST_FALSE_PLOTS = 3.0
"""Largest mean number of false plots in the window: with it one scan of 14,000 needs one slot more."""
LARGEST_ERROR = 1e3
"""Largest error of a measurement, standard deviations. Filters that take it for an outlier have positive definite
covariances up to some 3000 (``filters/contaminated_normal.py``), and a normal number reaches three."""


@dataclass(frozen=True)
class ManeuveringTargetParameters(TaskParameters):
    """Constants of ManeuveringTarget; each is a keyword of ``gym.make``."""

    sampling_interval: float = parameter(6.0, above=0.0, at_most=86400.0)
    """Scan period T, s (paper)."""
    horizon: int = parameter(100, at_least=1)
    """Scans acted on in one episode (paper: the axis of its figure 5)."""
    range_sigma: float = parameter(100.0, above=0.0)
    """Standard deviation of the range, m (paper)."""
    bearing_sigma: float = parameter(0.25, above=0.0, below=90.0)
    """Standard deviation of the azimuth, degrees (paper)."""
    polar_measurements: bool = False
    """False: independent errors along x and y with variances (22), (23) (paper). True: errors of range and
    azimuth, converted to x and y."""
    gains: tuple[float, ...] = parameter((0.3, 0.7), above=0.0, below=1.0)
    """Position gains alpha of the bank's filters (paper)."""
    likelihood_covariance: str = parameter("carried", choices=("carried", "steady-state"))
    """Innovation covariance in the likelihood (11) of the bank's filters. The paper prints none. "carried": S = P + R,
    P by the Joseph form with the gains in use. "steady-state": S = R / (1 - alpha), as of a Kalman filter that has
    settled to the gain (ours, both)."""
    transition: tuple[tuple[float, ...], ...] = parameter(
        ((0.9, 0.1), (0.1, 0.9)), at_least=0.0, at_most=1.0, stochastic=True
    )
    """Mode transition probabilities, row = from, column = to (paper)."""
    initial_probabilities: tuple[float, ...] = parameter(
        (0.5, 0.5), at_least=0.0, at_most=1.0, stochastic=True
    )
    """Mode probabilities at the start (paper)."""
    alpha_range: tuple[float, float] = parameter((0.05, 0.95), above=0.0, below=1.0, ascending=True)
    """Position gain at action -1 and +1 of control ``gain`` (ours: stable, and wide enough for the best schedule
    with known manoeuvres, which uses 0.07 to 0.88)."""
    gain_logits: float = parameter(2.0, above=0.0, at_most=10.0)
    """Logits by which an action of one moves a filter's position gain under control ``gains`` (ours: from 0.3 to
    0.05 or 0.76, from 0.7 to 0.24 or 0.95, as the best schedule with known manoeuvres uses)."""
    evidence_scale: float = parameter(2.0, above=0.0)
    """Nats that an evidence of one adds to a mode's log-posterior. Ours: a new policy explores with a standard
    deviation of about one, which with 4 nats costs 45 % more than action zero, so that it learns to survive its own
    noise. Of 1, 2 and 4 a short training run gained most with 2. A policy that explores less may use more."""
    averaging_measurements: float = parameter(5.0, at_least=1.0)
    """Time constant of the exponential averages in the observation, scans (ours)."""
    detection_probability: tuple[float, float] = parameter((1.0, 1.0), above=0.0, at_most=1.0, ascending=True)
    """Limits of the probability that a scan sees the target; each episode draws its own (ours; the paper: always)."""
    scan_jitter: tuple[float, float] = parameter((0.0, 0.0), at_least=0.0, below=1.0, ascending=True)
    """Limits of the share j of the scan period by which scans come early at most; each episode draws its own. Scan k is
    at T (k - j u), u uniform on [0, 1), drawn for every scan: later than scan k - 1, whose u differs (ours; the paper:
    never)."""
    glint_probability: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability that both errors of a scan are those of glint, independent of other scans and unreported (ours)."""
    glint_factor: float = parameter(5.0, above=0.0, at_most=LARGEST_ERROR)
    """Ratio of the standard deviation of glint errors to that of the others (ours)."""
    coloured_sigma: tuple[float, float] = parameter(
        (0.0, 0.0), at_least=0.0, at_most=LARGEST_ERROR, ascending=True
    )
    """Limits of the standard deviation of coloured errors along x and y, or of range and azimuth where measurements are
    polar, first-order Gauss-Markov, beside the white ones and in units of theirs; each episode draws its own, and
    without a report (ours; the paper: none)."""
    coloured_time: tuple[float, float] = parameter((12.0, 60.0), above=0.0, ascending=True)
    """Limits of the correlation time of coloured errors, s; each episode draws its own (ours)."""
    bias: float = parameter(0.0, at_least=0.0, at_most=LARGEST_ERROR)
    """Constant errors along x and y, or of range and azimuth where measurements are polar, in units of the white ones'
    standard deviations, are drawn within this for each episode, and without a report (ours; the paper: none)."""
    clutter_density: tuple[float, float] = parameter((0.0, 0.0), at_least=0.0, ascending=True)
    """Limits of the density of false plots, per square kilometre; each episode draws its own. A Poisson number of them
    lies in the window (ours; the paper: none)."""
    clutter_window: float = parameter(3000.0, above=0.0)
    """Half width of the window of plots around the filter's predicted position, along x and y, m, where there is
    clutter
    (ours)."""
    gate: float = parameter(16.0, above=0.0)
    """Gate in clutter: the plot taken for the target's is the nearest to the predicted position, if its squared
    distance, normalised with the covariances of prediction and plot, is below this; otherwise the scan missed the
    target (ours).
    """
    gate_acceleration: float = parameter(3.0, at_least=0.0)
    """Standard deviation of an acceleration that the prediction of the gate allows for, m/s^2 (ours)."""
    undisturbed: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability of an episode without coloured errors, where others have some (ours)."""
    unmodelled_acceleration: float = parameter(0.87, at_least=0.0, at_most=100.0)
    """Usual acceleration of one axis, root of its mean square over the flights of ``random``, m/s^2; enters nothing but
    the covariance that control ``gain`` reports (ours)."""
    flight: str = parameter("random", choices=("maneuver", "random", "legs", "track"))
    """"maneuver": one manoeuvre at stated scans (paper). "random": drawn for each episode. "legs": straight
    legs and exact turns. "track": a table of states."""
    initial_position: tuple[float, float] = (-10000.0, 5000.0)
    """Initial x and y, m, of flights "maneuver" and "legs" (paper)."""
    initial_velocity: tuple[float, float] = (100.0, 0.0)
    """Velocity at the start, m/s, of flights "maneuver" and "legs" (paper)."""
    acceleration: tuple[float, float] = (-2.775, -2.775)
    """Acceleration during the manoeuvre of flight "maneuver", m/s^2 (paper)."""
    maneuver_steps: tuple[int, int] = parameter((50, 55), at_least=1, ascending=True)
    """First and last scan of that acceleration. Reading: x(k) = F x(k-1) + B w(k) with w at k = 50 to 55, six steps,
    because five would not turn the velocity by 90 degrees."""
    legs: tuple[tuple[float, float], ...] = ()
    """Duration (s) and turn rate (deg/s, anticlockwise positive, 0 = straight) of each leg of flight "legs"; after the
    last one it goes straight on."""
    leg_spread: float = parameter(0.0, at_least=0.0, below=1.0)
    """Largest relative deviation of a leg's duration, drawn for each episode (ours)."""
    start_spread: float = parameter(0.0, at_least=0.0)
    """Each coordinate of the start of flight "legs" is drawn within this of ``initial_position``, m (ours)."""
    course_spread: float = parameter(0.0, at_least=0.0, at_most=180.0)
    """Largest deviation of the direction of flight "legs" from that of ``initial_velocity``, deg (ours)."""
    mirrored: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability that all turns of flight "legs" go to the other side (ours)."""
    track: tuple[tuple[float, ...], ...] = ()
    """Rows x, y, vx, vy, each with horizon + 2 values one scan apart, of flight "track"."""
    track_scans: tuple[int, ...] = parameter((), at_least=1)
    """Scans of each of several flights, of which every episode flies one; ``track`` then contains them concatenated,
    each with two values more than scans. Empty: one flight."""
    start_range: tuple[float, float] = parameter((5e3, 60e3), above=0.0, ascending=True)
    """Limits of the range at the start of a random flight, m (ours)."""
    speed: tuple[float, float] = parameter((60.0, 300.0), above=0.0, ascending=True)
    """Limits of the speed at the start of a random flight, m/s (ours)."""
    maneuver_count: tuple[int, int] = parameter((0, 3), at_least=0, ascending=True)
    """Limits of the number of manoeuvres of a random flight (ours)."""
    maneuver_duration: tuple[int, int] = parameter((3, 12), at_least=1, ascending=True)
    """Limits of the duration of these manoeuvres, scans (ours)."""
    maneuver_acceleration: tuple[float, float] = parameter((0.5, 6.0), at_least=0.0, ascending=True)
    """Limits of the acceleration of these manoeuvres, m/s^2 (ours)."""

    @property
    def regular(self) -> bool:
        """Whether every scan comes on time and sees the target, without clutter."""
        on_time = self.detection_probability == (1.0, 1.0) and self.scan_jitter == (0.0, 0.0)
        return on_time and not self.cluttered

    @property
    def cluttered(self) -> bool:
        """Whether the radar reports false plots (clutter)."""
        return self.clutter_density[1] > 0.0

    @property
    def coloured(self) -> bool:
        """Whether measurement errors may be correlated from scan to scan."""
        return self.coloured_sigma[1] > 0.0

    @property
    def window_area(self) -> float:
        """Area of the window in which clutter is simulated, m^2."""
        return (2.0 * self.clutter_window) ** 2

    def check(self) -> None:
        """Raise ValueError for fields that contradict each other."""
        modes = len(self.gains)
        if modes < 2:
            raise ValueError(f"gains must name at least two filters, got {self.gains!r}")
        square_matrix("transition", self.transition, modes)
        check_length("initial_probabilities", self.initial_probabilities, modes)
        for i, leg in enumerate(self.legs):
            if leg[0] <= 0.0:
                raise ValueError(f"legs[{i}][0] must be a duration above 0 s, got {leg[0]!r}")
        if self.flight == "legs" and not self.legs:
            raise ValueError('flight "legs" needs at least one leg (duration in s, turn rate in deg/s)')
        if any(scans > self.horizon for scans in self.track_scans):
            raise ValueError(
                f"track_scans must not exceed the horizon {self.horizon}, got {self.track_scans!r}"
            )
        if any(scans % self.decision_interval for scans in self.track_scans):
            raise ValueError(
                f"track_scans must be multiples of decision_interval {self.decision_interval}, got {self.track_scans!r}"
            )
        most = 1e-6 * self.clutter_density[1] * self.window_area
        if most > MOST_FALSE_PLOTS:
            raise ValueError(
                f"clutter_density {self.clutter_density!r} puts {most:.3g} false plots into the window on average, "
                f"more than {MOST_FALSE_PLOTS:g}: choose a lower density, or a smaller clutter_window"
            )
        if self.flight == "track":
            if self.scan_jitter[1] > 0.0:
                raise ValueError(
                    f"a flight that is a table has no states between its scans, got scan_jitter {self.scan_jitter!r}: "
                    "leave it at (0, 0)"
                )
            if len(self.track) != 4:
                raise ValueError(f"track must have the four rows x, y, vx, vy, got {len(self.track)} rows")
            for row, name in zip(self.track, ("x", "y", "vx", "vy"), strict=True):
                check_length(
                    f"track {name}", row, sum(scans + 2 for scans in self.track_scans or (self.horizon,))
                )
