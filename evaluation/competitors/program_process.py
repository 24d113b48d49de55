"""Process of a competing program, and exchange of messages with it through pipes.

A request is written and a response read at the same time, so that neither side waits for the other with a full pipe. A
program that ends, is late or writes too much raises a :class:`Failure` with its reason. The process and all that it has
started end with the object, or with Python.
"""

import os
import selectors
import signal
import struct
import subprocess
import sys
import time
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.util import cache_from_source
from typing import NamedTuple

from . import isolated_estimator


def quickest_form(source: str) -> str:
    """Return the path of a Python file's compiled form, or the source if that form is missing or outdated."""
    compiled = cache_from_source(source)
    try:
        with open(compiled, "rb") as file:
            header, now = file.read(16), os.stat(source)
    except OSError:
        return source
    # The header that the import system writes: no flags, then date and size of the source.
    mark = struct.pack("<LLL", 0, int(now.st_mtime) & 0xFFFFFFFF, now.st_size & 0xFFFFFFFF)
    return compiled if header[4:] == mark else source


LAUNCHER = quickest_form(isolated_estimator.__file__)
ENDED, LATE, WRONG = 6, 7, 8
"""Numbers among :data:`..storage.dataset.FAULTS`: the program ended, did not respond in time, or wrote no valid
estimate.
"""
START_SECONDS = 30.0
"""Least time limit for the first response, s, since an interpreter starts slowly."""
END_SECONDS = 1.0
"""Time in which a program must end after its input is closed, s."""
PIPE_BYTES = 1 << 20
"""Size of a pipe, bytes, where the system can set it: large enough for a message of a thousand tracks."""
MORE = "it has written more than one response"
LAST_WORDS = 2000
"""Number of the last bytes of standard error that are stored."""


class Limits(NamedTuple):
    """Time and memory limits of a program."""

    seconds: float = 10.0
    """Time limit for each response, s."""
    memory: float = 4000.0
    """Limit of the address space, MB; 0: no limit. Only Linux applies it."""


class Failure(Exception):  # noqa: N818  (a program's failure, not an error of this package)
    """Error for a missing or invalid response of a program."""

    def __init__(self, fault: int, words: str) -> None:
        super().__init__(words)
        self.fault = fault


class ProgramProcess:
    """A running program, with pipes to its standard input and output and a limit of time for each response.

    Args:
        command: the program and its arguments; no shell runs it. Empty: an estimator, see :mod:`.isolated_estimator`.
        limits: limits of its time and memory.
        environment: environment variables; None: those of this process.

    Raises:
        OSError: if it cannot be started.
    """

    def __init__(
        self, command: Sequence[str], limits: Limits, environment: Mapping[str, str] | None = None
    ) -> None:
        self.limits = limits
        memory, linux = str(int(limits.memory * 1e6)), sys.platform == "linux"
        launch = [sys.executable, "-I", "-S", "-B", LAUNCHER, memory]
        self._process = process = subprocess.Popen(
            [*launch, *command] if linux or not command else list(command),
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=None if environment is None else dict(environment),
            start_new_session=True,  # Ctrl-C is for this process, which ends the whole group
        )
        self._selector = selectors.DefaultSelector()
        self.end = weakref.finalize(self, _end, process, self._selector)
        streams = (process.stdin, process.stdout, process.stderr)
        self._to, self._from, self._errors = (stream.fileno() for stream in streams if stream is not None)
        for pipe in (self._to, self._from, self._errors):
            os.set_blocking(pipe, False)
            _widen(pipe)
        self._selector.register(self._from, selectors.EVENT_READ)
        self._selector.register(self._errors, selectors.EVENT_READ)
        self._buffer, self._last_words = bytearray(), b""
        self._seconds = max(limits.seconds, START_SECONDS)

    def exchange(self, request: bytes, size: int | None, most: int = 0) -> bytes:
        """Write a request to the program, wait for its response and return it.

        Args:
            request: bytes of the request.
            size: number of bytes of the response; None: it is a line.
            most: limit of bytes of a line.

        Raises:
            Failure: if there is no such response in time.
        """
        unsent, until = memoryview(request), time.monotonic() + self._seconds
        self._read(self._from)
        if self._buffer:
            raise Failure(WRONG, MORE)
        while True:
            if unsent:
                unsent = self._write(unsent)
            if not unsent and (found := self._whole_response(size, most)) is not None:
                self._seconds = self.limits.seconds
                return found
            left = until - time.monotonic()
            if left <= 0.0:
                raise Failure(LATE, f"it has not responded within {self._seconds:g} s")
            for key, _ in self._selector.select(left):
                self._read(key.fd)

    def send(self, message: bytes) -> None:
        """Write a message without a response to the program."""
        self.exchange(message, 0)

    def finish(self) -> None:
        """Close the program's input and wait ``END_SECONDS`` for its end; raise Failure if it writes more."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        until, goes_on = time.monotonic() + END_SECONDS, True
        while goes_on and not self._buffer and (left := until - time.monotonic()) > 0.0:
            for key, _ in self._selector.select(left):
                if key.fd == self._from:
                    found = os.read(self._from, PIPE_BYTES)
                    self._buffer += found
                    goes_on = bool(found)
                else:
                    self._read(key.fd)
        if self._buffer:
            raise Failure(WRONG, MORE)

    def _write(self, unsent: memoryview) -> memoryview:
        """Write as much of a message as the pipe takes now; return the rest."""
        try:
            unsent = unsent[os.write(self._to, unsent) :]
        except BlockingIOError:
            pass
        except OSError:  # the program has closed its input
            raise self._explain_end() from None
        waits = self._to in self._selector.get_map()
        if unsent and not waits:
            self._selector.register(self._to, selectors.EVENT_WRITE)
        elif waits and not unsent:
            self._selector.unregister(self._to)
        return unsent

    def _read(self, pipe: int) -> None:
        if pipe == self._to:
            return
        try:
            found = os.read(pipe, PIPE_BYTES)
        except BlockingIOError:
            return
        if pipe == self._errors:
            self._last_words = (self._last_words + found)[-LAST_WORDS:]
            if not found:
                self._selector.unregister(pipe)
        elif not found:
            raise self._explain_end()
        else:
            self._buffer += found

    def _whole_response(self, size: int | None, most: int) -> bytes | None:
        """Take one complete response from the bytes read so far; None if it is incomplete."""
        buffer = self._buffer
        if size is None:
            end = buffer.find(b"\n")
            if end < 0 and len(buffer) > most:
                raise Failure(WRONG, f"it has responded with a line of more than {most:,} bytes")
            size = end + 1
            if end < 0:
                return None
        if len(buffer) < size:
            return None
        found = bytes(buffer[:size])
        del buffer[:size]
        return found

    def _explain_end(self) -> Failure:
        """Return an error with the program's exit status and its last line on standard error."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        if self._errors in self._selector.get_map():
            with suppress(OSError):
                self._last_words += os.read(self._errors, PIPE_BYTES)
        lines = self._last_words.decode(errors="replace").strip().splitlines()
        code = self._process.returncode
        if code is None:
            words = "it has closed its standard input or output"
        elif code < 0:
            words = f"it was ended by {signal.Signals(-code).name}"
        else:
            words = f"it has ended with exit status {code}"
        last = "".join(c if c.isprintable() else " " for c in lines[-1][:200]) if lines else ""
        return Failure(ENDED, f"{words}: {last}" if last else words)

    @property
    def apart(self) -> bool:
        """Whether the program is in its own PID namespace, after its first response; True except on Linux."""
        try:
            return os.readlink(f"/proc/{self._process.pid}/ns/pid_for_children") != os.readlink(
                "/proc/self/ns/pid"
            )
        except OSError:
            return sys.platform != "linux"

    @property
    def processor_seconds(self) -> float:
        """Processor time of the process and its descendants, s; NaN where the system does not report it."""
        if sys.platform != "linux":
            return float("nan")
        children: dict[int, list[int]] = {}
        ended = {}
        for name in filter(str.isdigit, os.listdir("/proc")):
            with suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
                state = file.read().rpartition(b")")[2].split()
                children.setdefault(int(state[1]), []).append(int(name))
                ended[int(name)] = int(state[13]) + int(state[14])
        seconds, processes = 0.0, [self._process.pid]
        for process in processes:  # each count includes the children that have ended
            processes += children.get(process, [])
            try:
                seconds += time.clock_gettime((~process << 3) | 2)  # clock_getcpuclockid(3)
            except OSError:  # it has ended meanwhile
                seconds += float("nan") if process == self._process.pid else 0.0
            seconds += ended.get(process, 0) / os.sysconf("SC_CLK_TCK")
        return seconds


def _widen(pipe: int) -> None:
    if sys.platform == "linux":
        import fcntl

        with suppress(OSError):
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)


def _end(process: "subprocess.Popen[bytes]", selector: selectors.BaseSelector) -> None:
    selector.close()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            stream.close()
    with suppress(subprocess.TimeoutExpired):
        process.wait(END_SECONDS)  # a program ends when its standard input does
    process.terminate()  # its parent process ends all that it has started
    with suppress(subprocess.TimeoutExpired):
        process.wait(END_SECONDS)
    with suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
