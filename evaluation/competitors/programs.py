"""Programs in any language as competitors: separate processes that use standard input and output.

docs/programs.md describes version 1 of the protocol: a hello, the format of the messages, measurements and responses.
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
"""Version of the protocol."""
LONGEST_HELLO = 10_000
"""Maximal length of the response to the hello, bytes."""
BYTES_OF_NUMBER = 40
"""Maximal bytes of a number in JSON, with its separators."""
NO_NAMESPACES = "no PID namespace here: it could end or slow this process"
"""Warning before a program runs on a system without PID namespaces."""
USUAL = Limits()
LIMITS: ContextVar[Limits] = ContextVar("limits", default=USUAL)
"""Limits of the programs that are made while the context variable has this value."""


@contextmanager
def limit_programs(seconds: float, memory: float) -> Iterator[None]:
    """Set the limits of time, s, and memory, MB, for programs made inside the context.

    Raises:
        ValueError: for a time that is not above zero, or a negative memory.
    """
    if not seconds > 0.0 or not memory >= 0.0:
        raise ValueError(
            f"a time limit must be above zero and a memory limit not negative, got {seconds} and {memory}"
        )
    token = LIMITS.set(Limits(seconds, memory))
    try:
        yield
    finally:
        LIMITS.reset(token)


def search_path() -> str:
    """Return PATH for programs, with the virtual environment's folder first, so that ``python`` has the
    package.
    """
    usual = os.environ.get("PATH", os.defpath)
    return (
        usual if sys.prefix == sys.base_prefix else os.pathsep.join([os.path.join(sys.prefix, "bin"), usual])
    )


@dataclass(frozen=True)
class Program:
    """A program that competes as an estimator; a call with a task returns that estimator.

    Raises:
        ValueError: if there is no such program, or no system on which it could run.
    """

    command: str
    limits: Limits = field(default_factory=LIMITS.get)
    words: tuple[str, ...] | None = None
    """The program and its arguments; default: the command split as by a shell; empty: a Python estimator."""
    preface: bytes = field(default=b"", repr=False)
    """Bytes that are written before the hello."""
    environment: tuple[tuple[str, str], ...] | None = None
    """Environment variables of the process; None: those of this process, with :func:`search_path`."""
    kind: ClassVar[Kind] = "estimator"
    is_program: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not hasattr(os, "killpg"):
            raise ValueError(
                "exec: and --isolated run a separate program, which needs Linux or macOS: on Windows use WSL"
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
        """Return the estimator that runs the program for a task."""
        return ProgramEstimator(task, self)


class ArrayField(NamedTuple):
    """Description of one array in the messages to a program."""

    name: str
    """Name, with dots between the names of nested fields."""
    shape: tuple[int, ...] | None
    """Shape for one track; None: the array exists in other scenarios, or in recordings, only."""
    type: str
    """``float64``, ``int64`` or ``bool``; in a frame all are float64."""
    about: str
    """Meaning and unit."""


def fields_of(part: Any, prefix: str = "") -> Iterator[ArrayField]:
    """Yield name, shape, type and meaning of each array of nested NamedTuples ``(..., N)``, depth first."""
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
    """Return the task's constants that JSON can represent, by name."""
    own = task.parameters
    found = {}
    for name in getattr(own, "__dataclass_fields__", ()):
        value = getattr(own, name)
        if value is None and hasattr(own, "value"):
            with suppress(KeyError):  # the parameter has no value in this task
                value = own.value(name)
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError):
            continue
        found[name] = value
    return found


def rows_of(part: Any, count: int) -> numpy.ndarray:
    """Flatten nested tuples of arrays ``(..., N)`` to one row of numbers for each track,
    ``(count, numbers)``.
    """
    flat = [numpy.asarray(a, dtype="<f8").reshape(-1, numpy.shape(a)[-1])[:, :count] for a in leaves(part)]
    return numpy.ascontiguousarray(numpy.concatenate(flat).T)


def as_lists(values: numpy.ndarray) -> Any:
    """Return an array as nested lists, with None in place of numbers that are not finite."""
    held = values.astype(object)
    held[~numpy.isfinite(values)] = None
    return held.tolist()


class ProgramEstimator:
    """Estimator that runs a program for all episodes, see :class:`.kinds.Estimator`.

    A fault of the program does not end an evaluation: all tracks are lost with a warning.

    Attributes:
        tracks: number of the N lanes that are tracks; the others repeat the last one.
        last: number of the last measurement, after which the program must write nothing more; None: unknown.
        fault: number among ``FAULTS`` of the reason for a missing response; 0 while it responds.
        feedback: the program's feedback to the world, ``(..., N)``; None where it writes none.
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
        """Description of the feedback, which the hello offers; None if the program does not use it."""
        self._process: ProgramProcess | None = None
        self._format = ""
        self._initial: numpy.ndarray | None = None
        self._fields: list[ArrayField] = []

    def start(self, initial: Any, N: int) -> int:
        """Start the program; return the estimator's memory, the number zero of measurements so far.

        The hello is sent with the first measurement, since it describes its fields.

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
        """Send a measurement to the program; return its means, covariances and the memory.

        Raises:
            ValueError: if the program takes no part, or for an earlier memory, since a process cannot go back.
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
                found = self._exchange(rows_of(measurement, self.count), C)
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
            answer = numpy.full((self.count, self._response_size), numpy.nan)
        lanes = numpy.minimum(numpy.arange(width), self.count - 1)
        answer = answer[lanes].T
        if self._feedback_field is not None:
            self.feedback = answer[C + C * C :].reshape(*(self._feedback_field.shape or ()), width)
        return answer[:C], answer[C : C + C * C].reshape(C, C, width), self.step_number

    def processor_seconds(self) -> float:
        """Return the processor time of the program, s; NaN if it is unknown."""
        return float("nan") if self._process is None else self._process.processor_seconds

    def end(self) -> None:
        """End the program's process, if it runs."""
        if self._process is not None:
            self._process.end()
            self._process = None

    def hello(self, measurement: Any) -> dict[str, Any]:
        """Return the first message to the program: components, fields of messages, number of tracks.

        Keys for programs in plain C come first.
        """
        C, measured = len(self.task.components), list(fields_of(measurement))
        numbers = {
            "initial": _count_entries(self._fields),
            "measurement": _count_entries(measured),
            "answer": C + C * C,
        }
        offered = {}
        if self._feedback_field is not None:
            offered = {"feedback": [self._feedback_field._asdict()]}
            numbers["feedback"] = _count_entries([self._feedback_field])
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
    def _response_size(self) -> int:
        C = len(self.task.components)
        return C + C * C + (0 if self._feedback_field is None else _count_entries([self._feedback_field]))

    def _greet(self, measurement: Any) -> None:
        """Exchange the first messages with the program: hello, format of messages, initial estimate."""
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
                f'it has not responded to the hello with {{"filtergym": {VERSION}, "format": "json" or "float64"}}',
            )
        gaps = answer.get("warning", "" if self._process.apart or not self.program.words else NO_NAMESPACES)
        if isinstance(gaps, str) and gaps:
            warnings.warn(f"program {self.program.command!r}: {gaps[:500]}", stacklevel=2)
        self._format = answer["format"]
        if answer.get("feedback") is not True:
            self._feedback_field = None
        self._process.send(self._message("initial", self._fields, self._initial))
        self._fields = list(fields_of(measurement))

    def _message(self, name: str, fields: Sequence[ArrayField], rows: numpy.ndarray) -> bytes:
        if self._format == "float64":
            return rows.tobytes()
        content, place = {}, 0
        for own in fields:
            if own.shape is None:
                continue
            size = _count_entries([own])
            values = rows[:, place : place + size].reshape(-1, *own.shape)
            content[own.name] = as_lists(values if own.type == "float64" else values.astype(own.type))
            place += size
        return json.dumps({name: content}).encode() + b"\n"

    def _exchange(self, rows: numpy.ndarray, C: int) -> numpy.ndarray:
        """Send a measurement; return the program's means and covariances as rows of numbers."""
        assert self._process is not None
        question = self._message("measurement", self._fields, rows)
        size = self.count * self._response_size
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


def _count_entries(fields: Sequence[ArrayField]) -> int:
    return sum(int(numpy.prod(own.shape, dtype=int)) for own in fields if own.shape is not None)


def _read_object(line: bytes) -> dict[str, Any]:
    """Parse a program's response as a JSON object; raise Failure otherwise."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        shown = "".join(c if c.isprintable() else " " for c in line[:80].decode(errors="replace"))
        raise Failure(WRONG, f"its response is no JSON object: {shown!r}")
    return found


def find_program(name: str, command: str, problem: Any, find: Any) -> Competitor:
    """Return the competitor named ``exec:COMMAND``, a program started by that command."""
    return Competitor(name, Program(command))
