"""Estimators of ManeuveringTarget that use all plots of a scan in clutter.

Equations: ``filters/data_association.py``. Without clutter each equals the estimator that it extends.
"""

from ...envs.contract.filter import Likelihood
from ...envs.contract.observation import Array
from ...envs.maneuvering_target.constant_velocity import KalmanModel
from ...envs.maneuvering_target.parameters import ManeuveringTargetParameters
from ...envs.maneuvering_target.semi_markov import SemiMarkov
from ...envs.maneuvering_target.task import ManeuveringTarget
from ...envs.maneuvering_target.world import Measurement
from ...filters import data_association, kalman
from ...filters.data_association import Plots
from ...filters.ordered_sums import ordered_sum
from ...filters.semi_markov import AgedHypotheses
from .estimators import ConstantVelocity, KalmanInteractingMultipleModel


class AllPlots(KalmanModel):
    """Base of filters with probabilistic data association in place of the nearest plot.

    The density of false plots is unknown; it is estimated by that of the plots of the scan (nonparametric; Bar-Shalom
    and Fortmann 1988, section 6.4).
    """

    detection_probability: float = 0.9

    def density(self, plots: Plots) -> Array:
        """Return the number of a scan's plots, at least one, over the area of its window, 1/m^2, ``(N,)``."""
        parameters: ManeuveringTargetParameters = self.task.parameters
        count = ordered_sum(plots.available[i] for i in range(plots.available.shape[0]))
        return self.xp.clip(count, 1.0, None) / parameters.window_area

    def update_estimate(
        self, predicted: tuple[Array, Array], measurement: Measurement, H: Array | None = None
    ) -> kalman.Update:
        """Update a predicted estimate with all plots of a scan, weighted by their probabilities."""
        plots = measurement.plots
        if plots is None:
            return super().update_estimate(predicted, measurement, H)
        density = self.density(plots)
        return data_association.update_position(*predicted, plots, self.detection_probability, density)

    def likelihood(self, measurement: Measurement, log_likelihood: Array, nis: Array) -> Likelihood:
        """Return the likelihood of a scan without clutter; NaN for several plots, whose densities are not
        comparable.
        """
        if measurement.plots is None:
            return super().likelihood(measurement, log_likelihood, nis)
        return Likelihood.unknown(log_likelihood)


class ProbabilisticDataAssociation(AllPlots, ConstantVelocity):
    """One Kalman filter of constant velocity that weighs all plots of a scan (Bar-Shalom and Tse 1975).

    Args:
        acceleration: standard deviation of the acceleration, constant from scan to scan, m/s^2.
    """

    def __init__(self, task: ManeuveringTarget, acceleration: float = 3.0) -> None:
        super().__init__(task, acceleration)


class InteractingMultipleModelDataAssociation(AllPlots, KalmanInteractingMultipleModel):
    """The usual IMM over two Kalman filters of constant velocity, each of which weighs all plots of a scan."""


class SemiMarkovDataAssociation(SemiMarkov, AllPlots):
    """The semi-Markov Gaussian sum, each of whose hypotheses weighs all plots of a scan."""

    def update_table(self, table: AgedHypotheses, measurement: Measurement) -> kalman.Update:
        """Update every hypothesis of a table with all plots of a scan."""
        plots = measurement.plots
        if plots is None:
            return super().update_table(table, measurement)
        each = Plots(plots.position[:, :, None], plots.variance[:, :, None], plots.available[:, None])
        density = self.density(plots)
        return data_association.update_position(
            table.mean, table.covariance, each, self.detection_probability, density
        )
