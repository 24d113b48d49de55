"""What world, filters and picture of UavAutopilot use of their task: the design of the loop, sensors and output."""

from ..contract.observation import Array
from ..contract.task import Component, Task
from .parameters import COORDINATES, NOMINAL_SIGMAS, OUTPUT, UavAutopilotParameters
from .plant import Design, design


class AutopilotProblem(Task):
    """The loop as it is designed: plant, sensors, output and autopilot."""

    parameters: UavAutopilotParameters

    def set_up(self) -> None:
        """Design the loop."""
        p = self.parameters
        self.design: Design = design(p)
        self.components: tuple[Component, ...] = COORDINATES[p.plant]
        names = [c.name for c in self.components]
        self.sensors: tuple[str, ...] = p.value("sensors")
        self.measured: tuple[int, ...] = tuple(names.index(sensor) for sensor in self.sensors)
        """Coordinate that each sensor reads."""
        self.output: int = names.index(OUTPUT[p.plant])
        """Coordinate that the command is for."""
        sigmas = dict(zip(self.sensors, p.value("sensor_sigmas"), strict=True))
        self.sensor_variances: tuple[float, ...] = tuple(float(sigma) ** 2 for sigma in sigmas.values())
        """Nominal, of each sensor."""
        self.output_sigma: float = float({**NOMINAL_SIGMAS[p.plant], **sigmas}[OUTPUT[p.plant]])
        """Nominal sigma of the output's sensor; of its default where the output is not measured."""
        self.cost_unit: float = self.output_sigma**2
        """What a cost of one is in units of the weighted squares, for comparison with theory."""
        self._L = self.constant(self.design.feedback)

    def _sampling_interval(self) -> float:
        """Return what was left to the plant too, s."""
        return float(self.parameters.value("sampling_interval"))

    def autopilot(self, estimate: Array, command: Array) -> Array:
        """Return the control that follows from estimate ``(n, N)`` and command ``(N,)``, ``u = N r - L x(k|k)``,
        ``(N,)``.
        """
        return self.design.feedforward * command - self.xp.matmul(self._L, estimate)[0]

    def readings_of(self, state: Array) -> Array:
        """Return the measured coordinates of ``(n, N)``, ``(m, N)``."""
        return self.xp.stack([state[i] for i in self.measured])
