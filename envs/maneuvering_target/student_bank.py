r"""The fully learned estimator ``student``: a network outputs corrections and covariance at every measurement.

It contains no Kalman filter. An environment declares its frame, its units and its motion (:class:`StudentBank`);
the rest is the same everywhere. With U the rotation into the frame, s the unit of each component in it, m the last
motion output and nu the innovation over the sensor's sigma, zero where nothing was received,

    predict   x' = f(x, m)
    update    x = x' + U^T diag(s) c,  c_i = G_i (nu_j + sum_k a_ik nu_k + offset_reach a_i),  k other than j
    motion    m_l = G_i a_l
    report    P = U^T diag(s) L L^T diag(s) U,  L_ii = deviation_range^a_ii,  L_ij = coupling_reach L_ii a_ij  (j < i)

with a in [-1, 1] the network's outputs, j the axis that corrects component i, G_i = logistic(logit G0_i + gain_reach
a) and i in m_l the component that is moved. All zero is a filter with the fixed gain G0. Gains are output as logits,
and other terms of a component are in units of its gain: in straight flight the best gains are some thousandths, and
any larger term makes the estimate drift. Its stability is not guaranteed: it loses the track where its network outputs
a wrong gain.

A network that is trained through its own recursive estimate is that of Haarnoja and others, "Backprop KF: Learning
Discriminative Deterministic State Estimators" (NeurIPS 2016); theirs outputs the measurement of a Kalman filter.
"""

import itertools
import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy

from ...filters.small_matrices import apply, outer, product, transpose
from ..contract.filter import Bank, Initial, Measurement, TaskT
from ..contract.observation import SIGNED_LOG, Array, Block

GAIN_REACH = 5.0
"""Logits by which an output of one moves a gain: from a half to 0.007 or 0.993."""
OFFSET_REACH = 2.0
"""Largest correction without an innovation, as an equivalent innovation in sigmas."""
DEVIATION_RANGE = 50.0
"""Largest factor and divisor of a reported deviation, before its correlation with earlier components."""
COUPLING_REACH = 4.0
"""Largest off-diagonal entry of the Cholesky factor over the diagonal one: correlations of up to 0.97."""


class View(NamedTuple):
    """A measurement and the estimate predicted to it, in the frame."""

    mean: Array
    """Predicted mean, ``(C, N)``."""
    frame: Array
    """Rotation U into the frame, ``(C, C, N)``."""
    unit: Array
    """Units s of the components in the frame, ``(C, N)``."""
    innovation: Array
    """Innovation nu over the sensor's sigma, ``(m, N)``."""


class StudentState(NamedTuple):
    """State of the learned estimator: estimate, covariance and network outputs."""

    mean: Array
    """Mean, ``(C, N)``; predicted between :meth:`StudentBank.predict` and the action."""
    covariance: Array
    """Last reported covariance, ``(C, C, N)``."""
    motion: Array
    """Last motion output, between -1 and 1, ``(k, N)``; one row of zeros where there is none."""
    view: View
    """Current measurement and the estimate predicted to it."""


class StudentBank(Bank[TaskT, Measurement, StudentState]):
    """Base class of the banks of ``student``, a learned estimator whose estimate the action corrects.

    A subclass defines how the estimate moves and in which frame it is corrected (:meth:`rotate`,
    :meth:`predict_view`), and further features (:attr:`features`).
    """

    gain: ClassVar[Sequence[tuple[int, float]]]
    """For each component the axis of the innovation that corrects it, and the gain G0 in (0, 1) of an untrained
    network."""
    axes: ClassVar[Sequence[str]]
    """Names of the numbers of an innovation, ``(m,)``."""
    motions: ClassVar[Sequence[int]] = ()
    """Index of the component that each motion output moves."""

    def __init__(self, task: TaskT, control: str) -> None:
        super().__init__(task, control)
        self.size: int = len(self.gain)
        self.measured: int = len(self.axes)

    @abstractmethod
    def rotate(self, mean: Array) -> Array:
        """Return the rotation U into the frame of an estimate, ``(C, C, N)``; an identity without a frame."""

    @abstractmethod
    def predict_view(self, mean: Array, motion: Array, measurement: Any) -> View:
        """Return the estimate predicted to a measurement, with frame, units and innovation.

        Args:
            mean: previous estimate, ``(C, N)``.
            motion: last motion output, ``(k, N)``.
            measurement: that arrives, whose missing values are zero.
        """

    @property
    @abstractmethod
    def features(self) -> Sequence[Block]:
        """Observation blocks beside the innovation, in units of the frame; a subclass declares them."""

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium box of gains, offsets, the Cholesky factor and the motion."""
        count = self.size * (self.measured + 1) + self.size * (self.size + 1) // 2 + len(self.motions)
        return gymnasium.spaces.Box(-1.0, 1.0, (count,), numpy.float32)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks: the innovation and the features, without the last action.

        Outputs vary little at the beginning of training: normalised by that spread, their gradients would grow with
        every scan.
        """
        return (
            Block(
                "innovation",
                lambda f, _: f.view.innovation,
                "the innovation over the sensor's sigma, in the frame",
                self.axes,
                SIGNED_LOG,
            ),
            *self.features,
        )

    def start(self, initial: Initial) -> StudentState:
        """Return the estimator's state at the start of the track, from the initial estimate."""
        frame, none = self.rotate(initial.mean), 0.0 * initial.mean
        motion = self.xp.stack([none[0]] * max(len(self.motions), 1))
        innovation = self.xp.stack([none[0]] * self.measured)
        view = View(initial.mean, frame, none + 1.0, innovation)
        return StudentState(initial.mean, initial.covariance, motion, view)

    def predict(self, state: StudentState, measurement: Measurement) -> StudentState:
        """Return the state predicted to the measurement with the last motion output, with the innovation."""
        view = self.predict_view(state.mean, state.motion, measurement)
        return state._replace(mean=view.mean, view=view)

    def act(self, state: StudentState, measurement: Measurement, action: Array) -> StudentState:
        """Return the state with the estimate corrected and its covariance set by the network's outputs."""
        xp, C, m = self.xp, self.size, self.measured
        a = xp.clip(xp.astype(action, xp.float64), -1.0, 1.0)
        ends = numpy.cumsum([0, C * m, C, C, C * (C - 1) // 2, len(self.motions)])
        by_gain, offset, diagonal, coupling, by_motion = (
            a[first:last] for first, last in itertools.pairwise(ends)
        )
        inverse, unit = transpose(state.view.frame), state.view.unit
        gains, corrections = self._correct(xp.reshape(by_gain, (C, m, -1)), offset, state.view.innovation)
        deviation = unit * xp.exp(math.log(DEVIATION_RANGE) * diagonal)
        factor, entry = [], iter(range(C * (C - 1) // 2))
        for i in range(C):
            beside = [COUPLING_REACH * deviation[i] * coupling[next(entry)] for _ in range(i)]
            factor.append(xp.stack([*beside, deviation[i], *([0.0 * deviation[i]] * (C - 1 - i))]))
        rotated = product(inverse, xp.stack(factor))
        covariance = outer(rotated[:, 0], rotated[:, 0])
        for column in range(1, C):
            covariance = covariance + outer(rotated[:, column], rotated[:, column])
        return state._replace(
            mean=state.mean + apply(inverse, unit * corrections),
            covariance=covariance,
            motion=xp.stack([gains[i] * answer for i, answer in zip(self.motions, by_motion, strict=True)])
            if self.motions
            else state.motion,
        )

    def _correct(self, by_gain: Array, offset: Array, innovation: Array) -> tuple[list[Array], Array]:
        gains, corrections = [], []
        for row, beyond, (axis, first) in zip(by_gain, offset, self.gain, strict=True):
            gain = 1.0 / (1.0 + (1.0 / first - 1.0) * self.xp.exp(-GAIN_REACH * row[axis]))
            moved_by = innovation[axis] + OFFSET_REACH * beyond
            for other in range(self.measured):
                if other != axis:
                    moved_by = moved_by + row[other] * innovation[other]
            gains.append(gain)
            corrections.append(gain * moved_by)
        return gains, self.xp.stack(corrections)
