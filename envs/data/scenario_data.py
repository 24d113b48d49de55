"""Data in the place of a scenario: objects that make one, and readers that find such data in files."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from ...extensions import READERS, load_present
from ..contract.companions import FlightScenarios, find_companion
from ..contract.task import Scenario, Task


class ScenarioData:
    """Data of which an environment makes a scenario."""

    def scenario(self, cls: type[Task], keywords: Mapping[str, Any]) -> Scenario:
        """Make a scenario of it.

        Args:
            cls: the environment.
            keywords: of ``gym.make`` beside the scenario, which win over parameters of the data.

        Raises:
            ValueError: if the environment cannot, or the data do not fit the parameters.
        """
        raise NotImplementedError

    def fields(self) -> dict[str, Any]:
        """Return what makes the same data again, by name, as a dictionary that may be given as scenario."""
        raise NotImplementedError


class FlightData(ScenarioData):
    """Flights, which every episode flies."""

    def scenario(self, cls: type[Task], keywords: Mapping[str, Any]) -> Scenario:
        """Make a scenario of it, as :meth:`ScenarioData.scenario`."""
        of_flights = find_companion(cls, FlightScenarios)
        if of_flights is None:
            raise ValueError(f"{cls.id} does not take flights as scenario")
        found: Scenario = of_flights.make(self, keywords)
        return found


class Reader(NamedTuple):
    """A kind of data in files, folders or dictionaries."""

    takes: Callable[[Any], bool]
    """Whether a value, which is no name of a scenario, names or holds data of this kind."""
    read: Callable[[Any, type[Task]], ScenarioData]
    """Returns the data of such a value for an environment; raises :class:`ValueError` for what cannot be read."""
    prefix: str = ""
    """With which a name of such data may begin."""
    endings: tuple[str, ...] = ()
    """Of the names of its files."""


def readers() -> Iterator[Reader]:
    """Yield the readers of the installation, in the order in which they are tried."""
    yield from load_present(READERS)
