"""Picture of an episode that is computed on request from the stored actions.

This module imports matplotlib; the environment imports it only for a render mode.
"""

import numpy

from ...filters.array_namespace import host_array
from ..contract.model import Model
from ..contract.observation import Array
from ..drawing.rendering import EpisodePicture
from ..engine.lanes import Lanes


class LatePicture:
    """Picture of one episode, computed only on request, from the episode's identity and actions.

    Libraries set a render mode for environments that are not displayed (Stable-Baselines3's ``make_vec_env`` always),
    and recording the values of a picture takes far longer than a step.
    """

    def __init__(self, picture: EpisodePicture) -> None:
        self.model: Model = picture.model
        self._picture = picture
        self._lanes = Lanes(picture.model, 1)
        self._identity: numpy.ndarray | None = None
        """Identity of an episode that has not begun in the picture."""
        self._actions: list[numpy.ndarray] = []
        """Actions not yet applied in the picture."""

    def begin(self, identity: numpy.ndarray) -> None:
        """Store the identity of a new episode, ``(2, 1)``."""
        self._identity, self._actions = identity, []

    def keep(self, action: Array) -> None:
        """Store an applied action, ``(A,)`` or a scalar."""
        self._actions.append(numpy.array(host_array(action)))

    @property
    def picture(self) -> EpisodePicture:
        """Up-to-date picture of the episode: the stored actions are applied first."""
        lanes, picture = self._lanes, self._picture
        if self._identity is not None:
            lanes.begin(self._identity)
            picture.begin(lanes.state)
            self._identity = None
        for action in self._actions:
            self._apply(action)
        self._actions = []
        return picture

    def _apply(self, action: numpy.ndarray) -> None:
        lanes, shown = self._lanes, self._lanes.observe()[0]
        for state, _ in lanes.decide(action[None]):
            self._picture.keep(state, action, shown)

    def frame(self) -> numpy.ndarray:
        """Return the picture of the episode as an image, ``(height, width, 3)`` bytes."""
        return self.picture.frame(self._lanes.state)

    def show(self) -> None:
        """Draw the episode into the window."""
        self.picture.show(self._lanes.state)

    def close(self) -> None:
        """Close the window and delete the figure."""
        self._picture.close()
