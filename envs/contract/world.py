"""Truth and sensors: the part of a task that is simulated, or replayed from a recording."""

import math
from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any, ClassVar, Generic, TypeVar

from .draws import Draws
from .faults import Disturbances
from .observation import Array
from .task_base import TaskBase

TaskT = TypeVar("TaskT", bound=TaskBase)
Truth = TypeVar("Truth")
Measurement = TypeVar("Measurement")


class World(ABC, Generic[TaskT, Truth, Measurement]):
    """Base class of a task's world: the simulated truth and the sensors.

    Attributes:
        initial_normals: standard normal numbers of the track's start.
        normals: standard normal numbers of each measurement.
        row_uniforms: uniform numbers of each measurement.
    """

    initial_normals: int
    normals: int
    row_uniforms: int = 0
    own_parameters: ClassVar[tuple[str, ...]] = ()
    """Parameters that only the simulated world reads and that are too much for a recording, such as tables."""
    received_field: ClassVar[str] = ""
    """Field of the measurement whose values are received only where its field ``available`` is above zero, of the same
    shape or ``(N,)``; empty where every value is received."""
    reading_field: ClassVar[str] = ""
    """Field of the measurement that sensors read with errors; empty: the received field."""
    stated_field: ClassVar[str] = ""
    """Field that states how large these errors are, variances where its name contains the word, else deviations;
    empty where a measurement does not state it."""
    elapsed_field: ClassVar[str] = ""
    """Field with the s since the last measurement that was received; empty where there is none."""
    cost_remedy: ClassVar[str] = ""
    """Remedy for an unknown component of the truth, in words that follow a list of columns."""

    disturbances: Disturbances = Disturbances(())
    """Disturbances that the world may apply to its sensors."""

    def __init__(self, task: TaskT) -> None:
        self.task = task
        self.parameters: Any = task.parameters
        self.xp: ModuleType = task.xp

    @abstractmethod
    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Any]:
        """Return the true state at the start of the track, and the initial estimate given to every filter.

        Args:
            draws: random quantities of each episode.
            normals: ``(initial_normals, N)``, for the errors of the start.

        Returns:
            The truth, and an :class:`Initial` or a NamedTuple that has its fields.
        """

    @abstractmethod
    def advance(self, truth: Truth, noise: Array, feedback: Any) -> tuple[Truth, Measurement]:
        """Return the true state at the next measurement, and that measurement's readings (step 1 of the clock).

        Args:
            truth: at the previous measurement.
            noise: ``(normals + row_uniforms, N)``.
            feedback: in a closed loop, the result of :meth:`.Task.feedback`; else None.
        """

    def state(self, truth: Truth) -> Array:
        """Return the true values of the task's components, ``(C, N)``; by default the truth's ``state``."""
        state: Array = truth.state  # type: ignore[attr-defined]
        return state

    def mask_missing(self, measurement: Measurement) -> Measurement:
        """Return the measurement with NaN for every value that was not received, as estimators get it.

        The filters of a bank weight a value by its availability, so its number does not matter to them. An estimator
        that ignores the availability must not use that number as a measurement. By default the values of
        ``received_field`` are replaced.
        """
        if not self.received_field:
            return measurement
        there: Any = measurement
        values = self.xp.where(there.available > 0.0, getattr(there, self.received_field), math.nan)
        replaced: Measurement = there._replace(**{self.received_field: values})
        return replaced

    def add_recorded_fields(self, measurement: Measurement) -> Measurement:
        """Return the measurement with zeros for None in fields that only recordings have; by default unchanged."""
        return measurement

    def component_readings(self, measurement: Measurement) -> Array | None:
        """Return the readings of the task's components, ``(C, N)``, for pictures; by default None.

        They are NaN where there is no reading, and None where the measured quantity is no component.
        """
        return None

    def component_deviations(self, measurement: Measurement) -> Array | None:
        """Return the stated standard deviations of :meth:`component_readings`, ``(C, N)``; by default None."""
        return None

    def reading_deviations(self, measurement: Measurement) -> Array:
        """Return the standard deviations of the readings' errors, in the shape of the readings.

        By default the square roots of ``stated_field``; a subclass may return nominal ones.
        """
        if not self.stated_field:
            raise NotImplementedError(
                f"{type(self).__name__} needs reading_deviations, or a stated_field of variances"
            )
        return self.xp.sqrt(getattr(measurement, self.stated_field))

    def error_cost(self, error: Array) -> Array:
        """Return the cost of an estimation error, ``(N,)``, without the truth; a subclass defines it or :meth:`cost`.

        Only with it recordings of the task can be evaluated.

        Args:
            error: estimate minus truth, ``(C, N)``, in the units of the task's components.
        """
        raise NotImplementedError(f"{type(self).__name__} needs error_cost, or a cost of its own")

    def cost(self, truth: Truth, mean: Array) -> Array:
        """Return the uncapped cost of an estimate, ``(N,)`` (step 5 of the clock).

        By default :meth:`error_cost`; where the estimate drives a control loop, the quadratic cost of the loop.

        Args:
            truth: at the measurement that the estimate is for.
            mean: of the estimate, ``(C, N)``.
        """
        return self.error_cost(self.task.subtract(mean, self.state(truth)))

    def counted_cost(self, truth: Truth, mean: Array) -> Array:
        """Return the part of an estimate's cost that enters the reward, not negative, ``(N,)``.

        By default all of it; a task may exclude a part that the estimate does not cause.
        """
        return self.cost(truth, mean)

    def records(self, truth: Truth) -> dict[str, Array]:
        """Return further values of the truth to record at each measurement by name, ``(N,)``; by default none."""
        return {}

    def context(self, truth: Truth) -> dict[str, Array]:
        """Return the random draws of the episode and their current values by name, ``(..., N)``; by default none.

        They are finite, their shapes constant. The time of an event that does not occur is -1.
        """
        return {}
