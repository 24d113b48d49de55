"""A Python estimator in a process of its own, which speaks the protocol of programs (docs/programs.md).

:mod:`.isolation` starts this file with the interpreter's ``-I -S``. Its first line of input is a request in JSON: the
source text of the estimator, or its file; the folders where libraries are; and what may be read at all. Then comes the
hello. Of the package there is only what the request carries as text, ``filtergym.adapters``, which knows no world and
no seed, so it does not matter how the package was installed. The rest cannot be imported: on Linux, Landlock
(landlock(7)) lets the process read the libraries and the folder of the estimator, write nothing, begin no other
program, open no TCP connection, and look into no other process. Elsewhere the package is only not on the path.
"""

import ctypes
import json
import os
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace
from typing import Any, BinaryIO

LANES = 8
"""The number of episodes is filled up to a multiple, as the package does: rounding depends on it."""
READ, LIST = 1 << 2, 1 << 3
"""Rights of Landlock to read a file and to list a folder; those handled are all that a version knows."""
RIGHTS = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 4: (1 << 15) - 1, 5: (1 << 16) - 1}
"""Rights over files, by the version of Landlock; later ones have as many as the last."""
OPEN = "no wall here, this system has no Landlock: it could read any file, the package's among them"
CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
"""System calls."""
END_WITH_PARENT, NO_NEW_PRIVILEGES = 1, 38
"""Of prctl(2)."""


def landlock_version() -> int:
    """Return the version of Landlock that this system has; zero or less: none."""
    if sys.platform != "linux":
        return 0
    version: int = ctypes.CDLL(None, use_errno=True).syscall(CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    return version


def wall(readable: list[str], listable: list[str]) -> bool:
    """Close this process in, for good; returns whether the system can.

    Args:
        readable: files and folders that may be read, with all below them.
        listable: folders of which the names may be read, with those of all folders below them.
    """
    version = landlock_version()
    if version < 1:
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(END_WITH_PARENT, 9, 0, 0, 0)  # whoever is killed cannot end this process
    rights = RIGHTS[min(version, max(RIGHTS))]
    # Files; to bind and to connect, from version 4 on; abstract sockets and signals, from 6 on.
    handled = (ctypes.c_uint64 * 3)(rights, 3 if version >= 4 else 0, 3 if version >= 6 else 0)
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    rules = libc.syscall(CREATE_RULESET, handled, ctypes.c_size_t(size), 0)
    for path, wanted in [*((path, READ | LIST) for path in readable), *((path, LIST) for path in listable)]:
        try:
            place = os.open(path, os.O_PATH | os.O_CLOEXEC)
        except OSError:
            continue
        allowed = wanted if os.path.isdir(path) else READ
        rule = allowed.to_bytes(8, "little") + place.to_bytes(4, "little")
        if libc.syscall(ADD_RULE, rules, 1, rule, 0):
            raise OSError(ctypes.get_errno(), f"landlock refuses {path}")
        os.close(place)
    if libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.syscall(RESTRICT_SELF, rules, 0):
        raise OSError(ctypes.get_errno(), "landlock restricts nothing")
    os.close(rules)
    return True


class SharedModules(MetaPathFinder, Loader):
    """Finds the modules of the package that a request carries as text, with the packages around them.

    Args:
        texts: by the names of modules.
    """

    def __init__(self, texts: dict[str, str]) -> None:
        self.texts = texts

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Find a module that is shared, or a package around one."""
        around = any(shared.startswith(name + ".") for shared in self.texts)
        return ModuleSpec(name, self, is_package=around) if around or name in self.texts else None

    def exec_module(self, module: ModuleType) -> None:
        """Run the text of a module; that of a package is empty."""
        name = module.__name__
        exec(compile(self.texts.get(name, ""), name, "exec", dont_inherit=True), module.__dict__)


def nested(values: dict[str, Any], name: str) -> Any:
    """Return a NamedTuple of arrays by their names, whose dots lead into further ones."""
    from collections import namedtuple

    parts: dict[str, Any] = {}
    for path, value in values.items():
        first, dot, rest = path.partition(".")
        if dot:
            parts.setdefault(first, {})[rest] = value
        else:
            parts[first] = value
    held = {key: nested(value, key) if isinstance(value, dict) else value for key, value in parts.items()}
    return namedtuple(name.capitalize(), list(held))(**held)


class Parameters(SimpleNamespace):
    """The constants of the task."""

    def value(self, name: str) -> Any:
        """Value of a constant."""
        return getattr(self, name)


def make_task(hello: dict[str, Any], numpy: ModuleType) -> Any:
    """Return what the constructor of an estimator is given in place of the task."""
    parameters = {k: tuple(v) if isinstance(v, list) else v for k, v in hello["parameters"].items()}
    components = tuple(SimpleNamespace(**own) for own in hello["components"])
    groups = {name: tuple(parts) for name, parts in hello["groups"].items()}
    return SimpleNamespace(
        id=hello["environment"],
        components=components,
        groups=groups,
        parameters=Parameters(**parameters),
        xp=numpy,
    )


class Frames:
    """Reads the frames that a hello announces."""

    def __init__(self, hello: dict[str, Any], numpy: ModuleType, channel: BinaryIO) -> None:
        self.hello, self.numpy, self.channel = hello, numpy, channel
        self.tracks = hello["tracks"]
        self.lanes = -(-self.tracks // LANES) * LANES

    def read(self, name: str) -> Any:
        """Return the next one as a NamedTuple of arrays ``(..., N)``, filled up by its last track; None at the end."""
        numpy, size = self.numpy, 8 * self.tracks * self.hello["numbers"][name]
        content = self.channel.read(size)
        if len(content) < size:
            return None
        rows = numpy.frombuffer(content, dtype="<f8").reshape(self.tracks, -1)
        rows = rows[numpy.minimum(numpy.arange(self.lanes), self.tracks - 1)].T
        values: dict[str, Any] = {}
        place = 0
        for own in self.hello[name]:
            shape = own["shape"]
            if shape is None:  # it is there in other scenarios
                values[own["name"]] = None
                continue
            count = int(numpy.prod(shape, dtype=int))
            part = rows[place : place + count].reshape(*shape, self.lanes)
            values[own["name"]] = numpy.array(part, dtype=own["type"], order="C")
            place += count
        return nested(values, name)


def load(request: dict[str, Any]) -> Any:
    """Return the class that a request names."""
    module = ModuleType(request["module"])
    module.__dict__["__file__"] = request["file"]
    sys.modules[request["module"]] = module
    exec(compile(request["source"], request["file"], "exec", dont_inherit=True), module.__dict__)
    found = getattr(module, request["name"], None)
    if not callable(getattr(found, "update", None)) or not callable(getattr(found, "start", None)):
        raise TypeError(f"{request['name']!r} is no estimator, which has the methods start and update")
    if getattr(found, "kind", "estimator") != "estimator" or getattr(found, "task_keywords", None):
        raise TypeError("only an estimator, in the environment as it is, runs in a process of its own")
    return found


def takes_problem(maker: Any) -> bool:
    """Whether a class or function is given the problem: its first argument has no default, or is called so."""
    import inspect

    try:
        first = next(iter(inspect.signature(maker).parameters.values()), None)
    except ValueError:  # of a class that is compiled
        return True
    return first is not None and (first.default is first.empty or first.name in ("task", "model"))


READINGS = ("z", "zk", "y", "meas", "measurement", "obs", "observation")
"""Names of what the ``update`` of a filter of one track takes first; its own state is in the object."""


def check_update_order(found: Any) -> None:
    """Raise ValueError if the names of what ``update`` takes put the memory behind the measurement, or have none."""
    import inspect

    try:
        names = [name for name in inspect.signature(found.update).parameters if name != "self"]
    except (AttributeError, TypeError, ValueError):  # without one, or compiled
        return
    if "memory" in names[1:]:
        raise ValueError(
            f"update takes the memory first, as update({', '.join(['memory', *(n for n in names if n != 'memory')])}), "
            f"but this one is update({', '.join(names)}): change the order of its arguments"
        )
    if names and names[0].lower() in READINGS:
        raise ValueError(
            f"update({', '.join(names)}) is of a filter that knows one track, and here N tracks run side by side: put "
            "it behind filtergym.adapters.SingleTrackEstimator, whose begin(initial), step(track, measurement) and "
            "estimate(track) call yours (docs/adapters.md)"
        )


def make(found: Any, task: Any) -> Any:
    """Make an estimator of its class, for the task if the constructor takes it."""
    check_update_order(found)
    if not isinstance(found, type):
        return found
    return found(task) if takes_problem(found) else found()


def main() -> None:
    """Serve one estimator."""
    questions, answers = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what an estimator prints is no answer
    request, hello = json.loads(questions.readline()), json.loads(questions.readline())
    closed = wall(request["readable"], request["listable"])
    sys.path[:] = request["path"]
    sys.meta_path.insert(0, SharedModules(request["shared"]))
    import numpy

    try:
        own = make(load(request), make_task(hello, numpy))
    except Exception as error:  # a module is a program: it can raise anything
        said: dict[str, Any] = {"error": f"{type(error).__name__}: {error}"}
    else:
        said = {"filtergym": 1, "format": "float64"} | ({} if closed else {"warning": OPEN})
    answers.write(json.dumps(said).encode() + b"\n")
    answers.flush()
    frames = Frames(hello, numpy, questions)
    if "error" in said or (initial := frames.read("initial")) is None:
        return
    memory = own.start(initial, frames.lanes)
    while (measurement := frames.read("measurement")) is not None:
        mean, covariance, memory, *_ = own.update(memory, measurement)
        C = len(hello["components"])
        mean, covariance = numpy.asarray(mean, dtype=float), numpy.asarray(covariance, dtype=float)
        for name, values, shape in (("mean", mean, (C,)), ("covariance", covariance, (C, C))):
            if values.shape != (*shape, frames.lanes):
                raise ValueError(f"the {name} must have shape {(*shape, frames.lanes)}, got {values.shape}")
        answer = numpy.concatenate([mean, covariance.reshape(C * C, -1)])[:, : frames.tracks].T
        answers.write(numpy.ascontiguousarray(answer, dtype="<f8").tobytes())
        answers.flush()


if __name__ == "__main__":
    main()
