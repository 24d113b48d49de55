"""Base class of the task UavAutopilot, used by its world, filters and picture."""

from ..contract.observation import Array
from ..contract.task import Component, Task
from .parameters import COORDINATES, NOMINAL_SIGMAS, OUTPUT, UavAutopilotParameters
from .plant import Design, design


class AutopilotProblem(Task):
    """Base class of the task: plant, sensors, output, autopilot and nominal filter."""

    parameters: UavAutopilotParameters

    def set_up(self) -> None:
        """Compute the design of the control loop, and the constants of sensors and output."""
        p = self.parameters
        self.design: Design = design(p)
        self.components: tuple[Component, ...] = COORDINATES[p.plant]
        names = [c.name for c in self.components]
        self.sensors: tuple[str, ...] = p.value("sensors")
        self.measured: tuple[int, ...] = tuple(names.index(sensor) for sensor in self.sensors)
        """Index of the coordinate of each sensor."""
        self.output: int = names.index(OUTPUT[p.plant])
        """Index of the commanded coordinate."""
        sigmas = dict(zip(self.sensors, p.value("sensor_sigmas"), strict=True))
        self.sensor_variances: tuple[float, ...] = tuple(float(sigma) ** 2 for sigma in sigmas.values())
        """Nominal variance of each sensor."""
        self.output_sigma: float = float({**NOMINAL_SIGMAS[p.plant], **sigmas}[OUTPUT[p.plant]])
        """Nominal sigma of the output's sensor; the default one if the output is not measured."""
        self.cost_unit: float = self.output_sigma**2
        """Unit of the cost in weighted squares, for comparison with theory."""
        self._L = self.constant(self.design.feedback)

    def _sampling_interval(self) -> float:
        return float(self.parameters.value("sampling_interval"))

    def autopilot(self, estimate: Array, command: Array) -> Array:
        """Return the autopilot's control ``u = N r - L x(k|k)``, ``(N,)``, from estimate ``(n, N)`` and command."""
        return self.design.feedforward * command - self.xp.matmul(self._L, estimate)[0]

    def readings_of(self, state: Array) -> Array:
        """Return the measured coordinates ``(m, N)`` of a state ``(n, N)``, without noise."""
        return self.xp.stack([state[i] for i in self.measured])
