"""Base class of the task ManeuveringTarget, used by its world, filters and picture."""

from ..contract.task import Task
from .parameters import ManeuveringTargetParameters
from .scans import has_regular_scans


class TargetProblem(Task):
    """Base class of the task: the radar's parameters, and whether its scans are regular."""

    parameters: ManeuveringTargetParameters

    def set_up(self) -> None:
        """Determine whether the scans are regular: on time, and all see the target."""
        self.regular: bool = self.parameters.regular and (
            self.recording is None or has_regular_scans(self.recording, self.parameters)
        )
        """Whether every scan sees the target, all of them one ``sampling_interval`` apart."""

    def _sampling_interval(self) -> float | None:
        return self.parameters.sampling_interval if self.regular else None
