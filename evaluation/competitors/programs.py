"""Programs of any language as competitors: each in a process of its own, over standard input and output.

The protocol is version 1; docs/programs.md says the same to whoever writes a program.

1. We write a line of JSON, the **hello**: what is estimated, the fields of what will come, and how many tracks
   there are.
2. The program answers with a line: the version, and in which format it wants the rest, ``json`` or ``float64``; or with
   an ``error``, one sentence, and then takes no part.
3. We write the initial estimate, which has no answer, and then one measurement after another. Each is answered with
   means and covariances, before the next one comes.
4. At the end we close the program's standard input, and it ends.

As ``json`` a message is a line, as ``float64`` a frame of little-endian numbers without a head: for every track its
fields, or mean and covariance, row by row. So thousands of tracks are one message.

Where the task says what feedback means (:class:`.ArrayMeanings`), the hello offers it, and a program that answers
``"feedback": true`` gives after mean and covariance what else steers the world.
"""

import json
import os
import shlex
import shutil
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy

from ...compiler.functions import leaves
from ...envs.contract.companions import array_meanings
from ...envs.contract.observation import Array
from ...envs.contract.task import Task, field_words
from .kinds import Competitor, Kind
from .program_process import WRONG, Failure, Limits, ProgramProcess

VERSION = 1
"""Of the protocol."""
LONGEST_HELLO = 10_000
"""Bytes of the answer to the hello."""
BYTES_OF_NUMBER = 40
"""Of JSON, at most, with what stands around it."""
NO_NAMESPACES = "no PID namespace here: it could end or slow this process"
"""What a system without them cannot close, before a program runs."""
USUAL = Limits()
LIMITS: ContextVar[Limits] = ContextVar("limits", default=USUAL)
"""Of the programs that are named while it is in force."""


@contextmanager
def limit_programs(seconds: float, memory: float) -> Iterator[None]:
    """Give limits to the programs that are named inside, see :class:`.program_process.Limits`.

    Raises:
        ValueError: for what is no limit.
    """
    if not seconds > 0.0 or not memory >= 0.0:
        raise ValueError(
            f"a time limit is above zero and a memory limit not below, got {seconds} and {memory}"
        )
    token = LIMITS.set(Limits(seconds, memory))
    try:
        yield
    finally:
        LIMITS.reset(token)


def search_path() -> str:
    """Return the folders where programs are looked for, with those of the virtual environment first that runs this
    process: ``python`` is the interpreter that has the package, whether the environment is activated or not.
    """
    usual = os.environ.get("PATH", os.defpath)
    return (
        usual if sys.prefix == sys.base_prefix else os.pathsep.join([os.path.join(sys.prefix, "bin"), usual])
    )


@dataclass(frozen=True)
class Program:
    """A program that competes, as an estimator; made for a task it waits for a track to begin.

    Args:
        command: the program and its arguments, one text as in a shell; nothing of it is given to one.
        limits: of its time for an answer and of its memory.
        words: see below, likewise the others.

    Raises:
        ValueError: if there is no such program, or no system on which it could run.
    """

    command: str
    limits: Limits = field(default_factory=LIMITS.get)
    words: tuple[str, ...] | None = None
    """Of the command; default: what a shell would make of it; none: of an estimator in Python."""
    preface: bytes = field(default=b"", repr=False)
    """What is written before the hello."""
    environment: tuple[tuple[str, str], ...] | None = None
    """Variables of the process; None: ours, with :func:`search_path`."""
    kind: ClassVar[Kind] = "estimator"
    is_program: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not hasattr(os, "killpg"):
            raise ValueError(
                "exec: and --isolated run a program of its own, which needs Linux or macOS: on Windows take WSL"
            )
        if self.words is not None:
            return
        try:
            words = tuple(shlex.split(self.command))
        except ValueError as error:
            raise ValueError(f"{self.command!r} is no command: {error}") from None
        if not words or shutil.which(words[0], path=search_path()) is None:
            raise ValueError(
                f"there is no program {words[0] if words else ''!r} to run: exec: takes a command, such as "
                "'exec:./tracker --fast'"
            )
        object.__setattr__(self, "words", words)

    def __call__(self, task: Task) -> "ProgramEstimator":
        """Make the estimator."""
        return ProgramEstimator(task, self)


class ArrayField(NamedTuple):
    """An array of what is written to a program."""

    name: str
    """The names that lead to it, with dots."""
    shape: tuple[int, ...] | None
    """Of one track; None: it is there in other scenarios, or in recordings."""
    type: str
    """``float64``, ``int64`` or ``bool``; in a frame all are float64."""
    about: str
    """What it is, and its unit."""


def fields_of(part: Any, prefix: str = "") -> Iterator[ArrayField]:
    """Say what the arrays of nested NamedTuples ``(..., N)`` are, in the order of ``leaves``."""
    about = field_words(type(part))
    for name, value in part._asdict().items():
        if isinstance(value, tuple):
            yield from fields_of(value, f"{prefix}{name}.")
        elif value is None:
            yield ArrayField(prefix + name, None, "", about.get(name, ""))
        else:
            array = numpy.asarray(value)
            kind = {"b": "bool", "f": "float64"}.get(array.dtype.kind, "int64")
            yield ArrayField(prefix + name, array.shape[:-1], kind, about.get(name, ""))


def parameters_of(task: Task) -> dict[str, Any]:
    """Return the constants of a task that JSON has words for, by name."""
    own = task.parameters
    found = {}
    for name in getattr(own, "__dataclass_fields__", ()):
        value = getattr(own, name)
        if value is None and hasattr(own, "value"):
            with suppress(KeyError):  # what nothing else decides either
                value = own.value(name)
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError):
            continue
        found[name] = value
    return found


def rows_of(part: Any, count: int) -> numpy.ndarray:
    """Return the numbers of nested tuples of arrays ``(..., N)``, those of a track in a row, ``(count, numbers)``."""
    flat = [numpy.asarray(a, dtype="<f8").reshape(-1, numpy.shape(a)[-1])[:, :count] for a in leaves(part)]
    return numpy.ascontiguousarray(numpy.concatenate(flat).T)


def as_lists(values: numpy.ndarray) -> Any:
    """Return nested lists of numbers, None where one is not finite."""
    held = values.astype(object)
    held[~numpy.isfinite(values)] = None
    return held.tolist()


class ProgramEstimator:
    """A program in the loop, see :class:`.kinds.Estimator`.

    What it does wrong ends no evaluation: all its tracks are lost from there on, and a warning says why.

    Args:
        task: the estimation problem.
        program: to run.

    Attributes:
        tracks: how many of the N lanes are tracks; the others repeat the last one.
        last: number of the last measurement, whose answer nothing may follow; None where that is not known.
        fault: number of the reason among ``FAULTS`` for which there is no answer; 0 while there is.
        feedback: what it has reported to steer the world, ``(..., N)``; None where it does not.
    """

    kind: ClassVar[Kind] = "estimator"
    is_program: ClassVar[bool] = True

    def __init__(self, task: Task, program: Program) -> None:
        self.task = task
        self.program = program
        self.tracks: int | None = None
        self.last: int | None = None
        self.fault: int = 0
        self.step_number: int = 0
        self.feedback: numpy.ndarray | None = None
        self._feedback_field: ArrayField | None = None
        """Feedback of a track: offered in the hello, and reported from then on; None where it is not."""
        self._process: ProgramProcess | None = None
        self._format = ""
        self._initial: numpy.ndarray | None = None
        self._fields: list[ArrayField] = []

    def start(self, initial: Any, N: int) -> int:
        """Start the program; what it is told waits for the first measurement, whose fields it is told too.

        Raises:
            ValueError: if it cannot be started.
        """
        self.end()
        self.fault, self.step_number = 0, 0
        self.count: int = N if self.tracks is None else self.tracks
        self._fields, self._initial = list(fields_of(initial)), rows_of(initial, self.count)
        self.feedback, self._feedback_field = None, None
        meaning = array_meanings(self.task).feedback
        if self.task.closes_loop and meaning:
            shape = self.task.feedback(initial.mean, initial.covariance, initial).shape[:-1]
            self._feedback_field = ArrayField("feedback", shape, "float64", meaning)
        try:
            own = self.program.environment
            variables = {**os.environ, "PATH": search_path()} if own is None else dict(own)
            self._process = ProgramProcess(self.program.words or (), self.program.limits, variables)
        except OSError as error:
            raise ValueError(f"{self.program.command!r} cannot be started: {error.strerror}") from None
        return 0

    def update(self, memory: int, measurement: Any) -> tuple[Array, Array, int]:
        """Ask it; the memory is the number of measurements.

        Raises:
            ValueError: if it takes no part, or is to go back, which a process cannot.
        """
        if memory != self.step_number:
            raise ValueError("a program cannot go back to an earlier measurement")
        self.step_number += 1
        C, width = len(self.task.components), numpy.shape(measurement[0])[-1]
        answer: numpy.ndarray | None = None
        if not self.fault:
            assert self._process is not None
            try:
                if memory == 0:
                    self._greet(measurement)
                found = self._ask(rows_of(measurement, self.count), C)
                if self.step_number == self.last:
                    self._process.finish()
                answer = found
            except Failure as failure:
                self.fault = failure.fault
                warnings.warn(
                    f"program {self.program.command!r}, measurement {self.step_number}: {failure}; {self.count} "
                    "episodes are lost from there on",
                    stacklevel=2,
                )
                self.end()
        if answer is None:
            answer = numpy.full((self.count, self._answer_size), numpy.nan)
        lanes = numpy.minimum(numpy.arange(width), self.count - 1)
        answer = answer[lanes].T
        if self._feedback_field is not None:
            self.feedback = answer[C + C * C :].reshape(*(self._feedback_field.shape or ()), width)
        return answer[:C], answer[C : C + C * C].reshape(C, C, width), self.step_number

    def processor_seconds(self) -> float:
        """Return the processor time that the program has taken, s; NaN where that is not known."""
        return float("nan") if self._process is None else self._process.processor_seconds

    def end(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.end()
            self._process = None

    def hello(self, measurement: Any) -> dict[str, Any]:
        """Return what a program is told first; what programs in plain C look for comes first in it."""
        C, measured = len(self.task.components), list(fields_of(measurement))
        numbers = {"initial": _count(self._fields), "measurement": _count(measured), "answer": C + C * C}
        offered = {}
        if self._feedback_field is not None:
            offered = {"feedback": [self._feedback_field._asdict()]}
            numbers["feedback"] = _count([self._feedback_field])
        return {
            "filtergym": VERSION,
            "tracks": self.count,
            "numbers": numbers,
            "formats": ["json", "float64"],
            "environment": self.task.id,
            "components": [
                {"name": own.name, "unit": own.unit, "period": own.period} for own in self.task.components
            ],
            "groups": {name: list(parts) for name, parts in self.task.groups.items()},
            "initial": [own._asdict() for own in self._fields],
            "measurement": [own._asdict() for own in measured],
            **offered,
            "parameters": parameters_of(self.task),
        }

    @property
    def _answer_size(self) -> int:
        """Numbers of a track that an answer has."""
        C = len(self.task.components)
        return C + C * C + (0 if self._feedback_field is None else _count([self._feedback_field]))

    def _greet(self, measurement: Any) -> None:
        """Say hello, and hand over the initial estimate."""
        assert self._process is not None
        assert self._initial is not None
        hello = self.program.preface + json.dumps(self.hello(measurement)).encode() + b"\n"
        answer = _read_object(self._process.exchange(hello, None, LONGEST_HELLO))
        if isinstance(answer.get("error"), str):
            self.end()
            raise ValueError(f"{self.program.command!r} takes no part: {answer['error'][:500]}")
        if answer.get("filtergym") != VERSION or answer.get("format") not in ("json", "float64"):
            raise Failure(
                WRONG,
                f'it has not answered the hello with {{"filtergym": {VERSION}, "format": "json" or "float64"}}',
            )
        gaps = answer.get("warning", "" if self._process.apart or not self.program.words else NO_NAMESPACES)
        if isinstance(gaps, str) and gaps:
            warnings.warn(f"program {self.program.command!r}: {gaps[:500]}", stacklevel=2)
        self._format = answer["format"]
        if answer.get("feedback") is not True:
            self._feedback_field = None
        self._process.tell(self._message("initial", self._fields, self._initial))
        self._fields = list(fields_of(measurement))

    def _message(self, name: str, fields: Sequence[ArrayField], rows: numpy.ndarray) -> bytes:
        if self._format == "float64":
            return rows.tobytes()
        content, place = {}, 0
        for own in fields:
            if own.shape is None:
                continue
            size = _count([own])
            values = rows[:, place : place + size].reshape(-1, *own.shape)
            content[own.name] = as_lists(values if own.type == "float64" else values.astype(own.type))
            place += size
        return json.dumps({name: content}).encode() + b"\n"

    def _ask(self, rows: numpy.ndarray, C: int) -> numpy.ndarray:
        """Answer to a measurement, ``(tracks, C + C * C)``."""
        assert self._process is not None
        question = self._message("measurement", self._fields, rows)
        size = self.count * self._answer_size
        if self._format == "float64":
            answer = self._process.exchange(question, 8 * size)
            return numpy.frombuffer(answer, dtype="<f8").reshape(self.count, -1)
        answered = _read_object(
            self._process.exchange(question, None, LONGEST_HELLO + BYTES_OF_NUMBER * size)
        )
        found = []
        asked = [("mean", (self.count, C)), ("covariance", (self.count, C, C))]
        if self._feedback_field is not None:
            asked.append(("feedback", (self.count, *(self._feedback_field.shape or ()))))
        for name, shape in asked:
            try:
                values = numpy.array(answered.get(name), dtype=float)  # None is NaN
            except (TypeError, ValueError):
                values = numpy.empty(0)
            if values.shape != shape:
                listed = " lists of ".join(map(str, shape))
                raise Failure(WRONG, f"its {name!r} is not {listed} numbers")
            found.append(values.reshape(self.count, -1))
        return numpy.concatenate(found, axis=1)


def _count(fields: Sequence[ArrayField]) -> int:
    """Return the numbers of a track."""
    return sum(int(numpy.prod(own.shape, dtype=int)) for own in fields if own.shape is not None)


def _read_object(line: bytes) -> dict[str, Any]:
    """Read an answer.

    Raises:
        Failure: if it is no object of JSON.
    """
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        shown = "".join(c if c.isprintable() else " " for c in line[:80].decode(errors="replace"))
        raise Failure(WRONG, f"it has answered with no object of JSON: {shown!r}")
    return found


def find_program(name: str, command: str, problem: Any, find: Any) -> Competitor:
    """Return the competitor of ``exec:COMMAND``."""
    return Competitor(name, Program(command))
