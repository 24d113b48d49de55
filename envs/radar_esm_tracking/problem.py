"""Base class of the task RadarEsmTracking, used by its world, filters and picture."""

import numpy

from ...filters import class_fusion, singer
from ...filters.class_fusion import Models
from ..contract.task import Task
from .parameters import RadarEsmTrackingParameters


class RadarEsmProblem(Task):
    """Base class of the task: classes and emitter types, and the models of each class."""

    parameters: RadarEsmTrackingParameters

    def set_up(self) -> None:
        """Count classes and emitter types, and compute the motion and measurement models of the classes."""
        p = self.parameters
        self.classes: int = len(p.manoeuvrability)
        self.types: int = len(p.recognition)
        models, _ = self.design_models(p)
        self.models: Models = class_fusion.Models(*(self.constant(matrix) for matrix in models))

    @staticmethod
    def design_models(p: RadarEsmTrackingParameters) -> tuple[class_fusion.Models, numpy.ndarray]:
        """Return the motion and measurement models of the classes, and initial covariances, ``(3, 3, M)``."""
        T = p.sampling_interval
        Q = []
        for alpha, sigma in zip(p.manoeuvrability, p.acceleration_sigma, strict=True):
            noise = singer.process_noise(alpha, sigma, T)
            if p.process_noise == "acceleration":
                noise = numpy.diag([0.0, 0.0, noise[2, 2]])
            Q.append(noise)
        models = class_fusion.Models(
            Phi=numpy.stack([singer.transition(alpha, T) for alpha in p.manoeuvrability], axis=-1),
            Q=numpy.stack(Q, axis=-1),
            H=numpy.eye(2, 3),
            R=numpy.diag([p.range_sigma**2, p.range_rate_sigma**2]),
        )
        starts = [numpy.diag([p.range_sigma, p.range_rate_sigma, s]) ** 2 for s in p.acceleration_sigma]
        return models, numpy.stack(starts, axis=-1)
