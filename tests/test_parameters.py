"""Limits beside their parameters: what one checker refuses, with one sentence each."""

from dataclasses import dataclass

import numpy as np
import pytest

from filtergym.envs.contract.parameters import TaskParameters, check_length, parameter, square_matrix


@dataclass(frozen=True)
class Everything(TaskParameters):
    """One of every kind."""

    number: float = parameter(1.0, above=0.0, at_most=2.0)
    count: int = parameter(3, at_least=1)
    word: str = parameter("a", choices=("a", "b"))
    flag: bool = False
    pair: tuple[float, float] = parameter((0.0, 1.0), at_least=0.0, ascending=True)
    steps: tuple[int, int] = parameter((1, 2), ascending=True)
    many: tuple[float, ...] = ()
    row: tuple[float, ...] = parameter((0.5, 0.5), at_least=0.0, at_most=1.0, stochastic=True)
    table: tuple[tuple[float, float], ...] = parameter(((0.0, 1.0),), ascending=True)
    perhaps: float | None = parameter(None, above=0.0)
    names: tuple[str, ...] | None = None

    def check(self) -> None:
        """Two fields together."""
        if self.count == 7 and self.flag:
            raise ValueError("count must not be 7 with flag")


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"number": "1"}, "number must be a finite number above 0.0 and at most 2.0, got '1'"),
        ({"number": True}, "number must be a finite number"),
        ({"number": 0.0}, "number must be .* above 0.0"),
        ({"number": float("inf")}, "number must be a finite number"),
        ({"count": 2.0}, "count must be an integer of at least 1, got 2.0"),
        ({"count": 0}, "count must be an integer of at least 1, got 0"),
        ({"word": "c"}, "word must be one of 'a', 'b', got 'c'"),
        ({"word": 3}, "word must be one of"),
        ({"flag": "false"}, "flag must be True or False, got 'false'"),
        ({"flag": 1}, "flag must be True or False, got 1"),
        ({"pair": (1.0, 0.0)}, "pair must be in ascending order"),
        ({"pair": (1.0,)}, "pair must be 2 numbers"),
        ({"pair": (-1.0, 0.0)}, r"pair\[0\] must be .* at least 0.0"),
        ({"steps": (1.5, 2.5)}, r"steps\[0\] must be an integer, got 1.5"),
        ({"many": 5}, "many must be a sequence of numbers, got 5"),
        ({"many": "5"}, "many must be a sequence of numbers, got '5'"),
        ({"many": (1.0, "2")}, r"many\[1\] must be a finite number, got '2'"),
        ({"row": (0.5, 0.6)}, "row must sum to 1, got .* with sum 1.1"),
        ({"table": ((0.0, 1.0), 5)}, r"table\[1\] must be 2 numbers, got 5"),
        ({"table": ((1.0, 0.0),)}, r"table\[0\] must be in ascending order"),
        ({"perhaps": -1.0}, "perhaps must be .* above 0.0"),
        ({"names": (1,)}, r"names\[0\] must be a word, got 1"),
        ({"horizon": 10, "decision_interval": 3}, "horizon must be a multiple of decision_interval"),
        ({"count": 7, "flag": True}, "count must not be 7 with flag"),
    ],
)
def test_refusals(keywords, message):
    with pytest.raises(ValueError, match=message):
        Everything(**keywords)


def test_what_is_taken():
    p = Everything(pair=[0, 1], many=np.arange(3.0), table=[[0, 2]], perhaps=None, number=np.float64(2.0))
    assert p.pair == (0, 1)
    assert p.many == (0.0, 1.0, 2.0)
    assert p.table == ((0, 2),)
    assert type(p.number) is float
    assert hash(p) == hash(Everything(pair=(0, 1), many=(0.0, 1.0, 2.0), table=((0, 2),), number=2.0))


def test_sizes_that_depend_on_others():
    with pytest.raises(ValueError, match="sigmas must be 3 numbers, got"):
        check_length("sigmas", (1.0, 2.0), 3)
    with pytest.raises(ValueError, match="transition must have 2 rows"):
        square_matrix("transition", ((1.0,),), 2)
