"""Data that act as a scenario: their base classes, and the readers of such data in files."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from ...extensions import READERS, load_present
from ..contract.companions import FlightScenarios, find_companion
from ..contract.task import Scenario, Task


class ScenarioData:
    """Base class of data from which an environment makes a scenario, such as flights or a recording."""

    def scenario(self, cls: type[Task], keywords: Mapping[str, Any]) -> Scenario:
        """Return the scenario that an environment makes of the data; subclasses define it.

        Args:
            cls: the environment.
            keywords: of ``gym.make`` beside the scenario, which override parameters of the data.

        Raises:
            ValueError: if the environment does not support such data, or the data do not fit the parameters.
        """
        raise NotImplementedError

    def fields(self) -> dict[str, Any]:
        """Return the constructor's arguments by name, also a valid scenario; subclasses define it."""
        raise NotImplementedError


class FlightData(ScenarioData):
    """Base class of flight data: every episode of a scenario flies one flight."""

    def scenario(self, cls: type[Task], keywords: Mapping[str, Any]) -> Scenario:
        """Return a scenario of an environment in which every episode flies one of the flights."""
        of_flights = find_companion(cls, FlightScenarios)
        if of_flights is None:
            raise ValueError(f"{cls.id} does not take flights as scenario")
        found: Scenario = of_flights.make(self, keywords)
        return found


class Reader(NamedTuple):
    """Functions that recognise and read one kind of scenario data, such as flights."""

    takes: Callable[[Any], bool]
    """Function that returns whether a value, not the name of a scenario, names or contains data of this kind."""
    read: Callable[[Any, type[Task]], ScenarioData]
    """Function that returns the data of such a value for an environment; raises ValueError for unreadable data."""
    prefix: str = ""
    """Prefix that a name of such data may have."""
    endings: tuple[str, ...] = ()
    """Suffixes of the names of its files."""


def readers() -> Iterator[Reader]:
    """Yield the installed readers of scenario data, in the order in which they are tried."""
    yield from load_present(READERS)
