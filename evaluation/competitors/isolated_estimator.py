"""Script of a sandboxed process, which runs a program or a Python estimator.

:mod:`.program_process` starts this file with the interpreter's ``-I -S``, the limit of memory in bytes, and
the words of a program (docs/programs.md). The program is executed in a PID namespace: all its processes end
with the first. On a system without such namespaces this process adopts the remaining processes and ends them.

Without words it runs an estimator. Its first line of input is a request in JSON: the source text of the estimator, or
its file; the folders of libraries; and the paths that may be read. Then comes the hello. The only part of the package
that can be imported is the text in the request, ``filtergym.adapters``, which contains no world and no seed; so the way
in which the package was installed does not matter. On Linux three layers restrict the process:

* namespaces (namespaces(7)) of the network, of System V and POSIX memory, and of processes;
* Landlock (landlock(7)): it reads libraries and the folder of the estimator, and writes nothing;
* a filter of system calls (seccomp(2)): calls outside the tables below fail, above all those for new processes.

On other systems the package is only missing from the path.
"""

from __future__ import annotations

import ctypes
import os
import sys

TYPE_CHECKING = False  # and further imports below, where they are needed: a program waits for those here
if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec
    from types import ModuleType
    from typing import Any, BinaryIO

LANES = 8
"""Number of lanes is a multiple of this, as in the package, since rounding depends on it."""
READ, LIST = 1 << 2, 1 << 3
"""Rights of Landlock to read a file and to list a folder."""
RIGHTS = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 4: (1 << 15) - 1, 5: (1 << 16) - 1}
"""Bit masks of all rights over files, by the version of Landlock; later versions have those of the last."""
CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
"""Numbers of Landlock's system calls."""
NEW_USER, NEW_PID, NEW_OTHERS = 0x10000000, 0x20000000, 0x48000000
"""Flags of unshare(2) for new namespaces: users; processes; network and IPC."""
KILL, TERMINATE = 9, 15
"""Numbers of the signals."""
END_WITH_PARENT, SET_FILTER, ADOPT, NO_NEW_PRIVILEGES = 1, 22, 36, 38
"""Options of prctl(2)."""
MACHINES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
"""Column of the table of system calls, and number of the architecture, by the name of a machine."""
CALLS = """
read 0 63, write 1 64, readv 19 65, writev 20 66, pread64 17 67, lseek 8 62, close 3 57, close_range 436 436,
dup 32 23, dup2 33 -, dup3 292 24, pipe 22 -, pipe2 293 59, poll 7 -, ppoll 271 73, select 23 -, pselect6 270 72,
fcntl 72 25, open 2 -, openat 257 56, fstat 5 80, stat 4 -, lstat 6 -, newfstatat 262 79, statx 332 291, access 21 -,
faccessat 269 48, faccessat2 439 439, readlink 89 -, readlinkat 267 78, getcwd 79 17, getdents64 217 61,
statfs 137 43, fstatfs 138 44, fadvise64 221 223, eventfd2 290 19, mmap 9 222, munmap 11 215, mprotect 10 226,
mremap 25 216, madvise 28 233, brk 12 214, membarrier 324 283, clone 56 220, clone3 435 435, futex 202 98,
set_robust_list 273 99, rseq 334 293, set_tid_address 218 96, prctl 157 167, sched_yield 24 124,
sched_getaffinity 204 123, sched_getparam 143 121, sched_getscheduler 145 120, getcpu 309 168, get_mempolicy 239 236,
getpid 39 172, getppid 110 173, gettid 186 178, getuid 102 174, geteuid 107 175, getgid 104 176, getegid 108 177,
uname 63 160, sysinfo 99 179, times 100 153, getrusage 98 165, getrlimit 97 163, prlimit64 302 261,
clock_gettime 228 113, clock_getres 229 114, clock_nanosleep 230 115, nanosleep 35 101, gettimeofday 96 169, time 201 -,
getrandom 318 278, rt_sigaction 13 134, rt_sigprocmask 14 135, rt_sigreturn 15 139, sigaltstack 131 132,
restart_syscall 219 128, kill 62 129, tgkill 234 131, exit 60 93, exit_group 231 94
"""
"""System calls that an estimator may make, with their numbers on both machines: files, memory, threads, time, exit."""
ANY, WRITING, THREAD = 0xFFFFFFFF, os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0x10000
"""Bit masks of arguments: all bits; those that open a file for writing; that for a thread instead of a process."""
FORBIDDEN, MISSING, PERMITTED = 0x50001, 0x50026, 0x7FFF0000
"""Return values of a seccomp filter: EPERM, ENOSYS, and allow."""


def enter_namespaces(libc: Any, wanted: int) -> bool:
    """Move this process (of the process ids its children) into new Linux namespaces; return whether it is
    permitted.
    """
    user, group = os.getuid(), os.getgid()
    if libc.unshare(wanted) == 0:
        return True
    if libc.unshare(NEW_USER | wanted):
        return False
    for name, words in (
        ("setgroups", "deny"),
        ("uid_map", f"{user} {user} 1"),
        ("gid_map", f"{group} {group} 1"),
    ):
        try:
            with open(f"/proc/self/{name}", "w") as file:
                file.write(words)
        except OSError:  # without it the process retains its rights over files
            pass
    return True


def continue_in_child(libc: Any, apart: bool) -> None:
    """Fork and continue in the child; the parent waits, ends its other children and exits with the child's
    status.
    """
    libc.prctl(ADOPT, 1, 0, 0, 0)
    if (child := os.fork()) == 0:
        libc.prctl(END_WITH_PARENT, KILL, 0, 0, 0)
        return
    for pipe in (0, 1, 2):
        os.close(pipe)
    if not apart:  # the first process of a namespace ends with its parent, and all others with that one
        import signal

        signal.signal(signal.SIGTERM, lambda *_: os._exit(end_children()))
    ended = status = 0
    while ended != child:
        ended, status = os.wait()
    code = os.waitstatus_to_exitcode(status)
    if os.getpid() == 1:  # which no signal ends
        os._exit(128 - code if code < 0 else code)
    end_children()
    if 0 < (number := -code if code < 0 else code - 128) < 32:
        limit_resource("RLIMIT_CORE", 0)
        libc.signal(number, None)
        os.kill(os.getpid(), number)
    os._exit(code)


def limit_resource(name: str, most: int) -> None:
    """Lower the limit of a resource of this process to ``most``, unless it is lower already."""
    import resource

    kind = getattr(resource, name)
    lowest = min([most, *(own for own in resource.getrlimit(kind) if own != resource.RLIM_INFINITY)])
    resource.setrlimit(kind, (lowest, lowest))


def end_children() -> int:
    """Kill all descendants of this process; return zero."""
    own = os.getpid()
    while True:
        try:
            os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return 0
        for name in filter(str.isdigit, os.listdir("/proc")):
            try:
                with open(f"/proc/{name}/stat", "rb") as file:
                    if int(file.read().rpartition(b")")[2].split()[1]) == own:
                        os.kill(int(name), KILL)
            except OSError:  # it has ended meanwhile
                pass


def landlock_version() -> int:
    """Return the version of Landlock that this system supports; zero or less: none."""
    if sys.platform != "linux":
        return 0
    version: int = ctypes.CDLL(None, use_errno=True).syscall(CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    return version


def restrict_files(libc: Any, version: int, readable: list[str], listable: list[str]) -> None:
    """Restrict this process by Landlock: it may read ``readable``, list ``listable``, and write no file."""
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
    if libc.syscall(RESTRICT_SELF, rules, 0):
        raise OSError(ctypes.get_errno(), "landlock restricts nothing")
    os.close(rules)


def filter_calls(libc: Any) -> bool:
    """Permit this process only the system calls of the table (seccomp); return whether the system supports it."""
    import struct

    column, machine = MACHINES.get(os.uname().machine, (0, 0))
    if not machine or sys.maxsize < 1 << 32:
        return False
    calls = {name: numbers[column] for name, *numbers in map(str.split, CALLS.split(","))}
    own = (os.getpid(),)
    # Of some calls words of their arguments: which, the bits that count, and what those may be.
    checks: dict[str, list[tuple[int, int, tuple[int, ...]]]] = {
        "clone": [(0, THREAD, (THREAD,))],
        "fcntl": [
            (2, ANY, (0, 1, 2, 3, 4, 1030))
        ],  # duplicate and flags; other commands watch files and send signals
        "kill": [(0, ANY, own)],
        "open": [(2, WRITING, (0,))],
        "openat": [(4, WRITING, (0,))],
        "prctl": [(0, ANY, (15, 16))],  # names of threads
        "prlimit64": [(0, ANY, (0,)), (4, ANY, (0,)), (5, ANY, (0,))],  # its own, and no new one
        "tgkill": [(0, ANY, own)],
    }
    # Of struct sock_filter: code, jumps if true and if false, value. Load is 0x20, and 0x54, jump if equal 0x15, end 6.
    code = [(0x20, 0, 0, 4), (0x15, 1, 0, machine), (6, 0, 0, FORBIDDEN), (0x20, 0, 0, 0)]
    for name, number in calls.items():
        block = []
        for word, bits, values in checks.get(name, []):
            block += [(0x20, 0, 0, 16 + 4 * word), (0x54, 0, 0, bits)]
            block += [(0x15, len(values) - i, 0, value) for i, value in enumerate(values)]
            block += [(6, 0, 0, FORBIDDEN)]
        block += [(6, 0, 0, MISSING if name == "clone3" else PERMITTED)]
        code += [(0x15, 0, len(block), int(number)), *block] if number != "-" else []
    code += [(6, 0, 0, FORBIDDEN)]
    content = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *one) for one in code))
    return bool(libc.prctl(SET_FILTER, 2, struct.pack("HP", len(code), ctypes.addressof(content)), 0, 0) == 0)


def restrict_process(readable: list[str], listable: list[str], apart: bool) -> str:
    """Restrict this process's files and system calls for good; return a sentence on remaining gaps, or empty
    text.
    """
    version, filtered = landlock_version(), False
    if sys.platform == "linux":
        libc = ctypes.CDLL(None, use_errno=True)
        libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0)
        if version > 0:
            restrict_files(libc, version, readable, listable)
        filtered = filter_calls(libc)
        if not (apart or filtered):
            limit_resource("RLIMIT_NPROC", 0)
    missing = {"Landlock": version > 0, "a filter of system calls": filtered, "namespaces": apart or filtered}
    gaps = {
        "read any file, the package's among them": version > 0,
        "write files": version > 0 or filtered,
        "leave notes in times and modes of files and in keyrings": filtered,
        "leave notes in shared memory, connect, and end or slow this process": filtered or apart,
    }
    without, could = ([name for name, closed in own.items() if not closed] for own in (missing, gaps))
    return (
        f"the isolation is incomplete, without {' and '.join(without)}: it could {', '.join(could)}"
        if could
        else ""
    )


class SharedModules:
    """Finder and loader of modules whose source texts are in the request, by name, and of their packages."""

    def __init__(self, texts: dict[str, str]) -> None:
        from importlib.machinery import ModuleSpec

        self.texts = texts
        self.new: Any = ModuleSpec

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the spec of a module in the request, or of a package that contains one; else None."""
        around = any(shared.startswith(name + ".") for shared in self.texts)
        return self.new(name, self, is_package=around) if around or name in self.texts else None

    def create_module(self, spec: ModuleSpec) -> None:
        """Return None: Python makes the module object."""

    def exec_module(self, module: ModuleType) -> None:
        """Execute the source text of a module, which is empty for a package."""
        name = module.__name__
        exec(compile(self.texts.get(name, ""), name, "exec", dont_inherit=True), module.__dict__)


def nested_tuple(values: dict[str, Any], name: str) -> Any:
    """Make nested NamedTuples of arrays from a mapping, at the dots in its names."""
    from collections import namedtuple

    parts: dict[str, Any] = {}
    for path, value in values.items():
        first, dot, rest = path.partition(".")
        if dot:
            parts.setdefault(first, {})[rest] = value
        else:
            parts[first] = value
    held = {
        key: nested_tuple(value, key) if isinstance(value, dict) else value for key, value in parts.items()
    }
    return namedtuple(name.capitalize(), list(held))(**held)


class Parameters:
    """The task's constants as attributes."""

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)

    def value(self, name: str) -> Any:
        """Return the value of a constant by its name."""
        return getattr(self, name)


def make_task(hello: dict[str, Any], numpy: ModuleType) -> Any:
    """Return the object that an isolated estimator receives as its task: constants, components and groups."""
    from types import SimpleNamespace

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
    """Reader of binary messages (frames) with the layout that the hello describes."""

    def __init__(self, hello: dict[str, Any], numpy: ModuleType, channel: BinaryIO) -> None:
        self.hello = hello
        self.numpy = numpy
        self.channel = channel
        self.tracks: int = hello["tracks"]
        self.lanes: int = -(-self.tracks // LANES) * LANES

    def read(self, name: str) -> Any:
        """Return the next frame as a NamedTuple of arrays ``(..., N)``, padded with its last track; None at the end."""
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
            if shape is None:  # the field exists in other scenarios only
                values[own["name"]] = None
                continue
            count = int(numpy.prod(shape, dtype=int))
            part = rows[place : place + count].reshape(*shape, self.lanes)
            values[own["name"]] = numpy.array(part, dtype=own["type"], order="C")
            place += count
        return nested_tuple(values, name)


def load_estimator(request: dict[str, Any]) -> Any:
    """Execute the estimator's source text in a request; return its class, checked for the methods of an
    estimator.
    """
    from types import ModuleType

    module = ModuleType(request["module"])
    module.__dict__["__file__"] = request["file"]
    sys.modules[request["module"]] = module
    exec(compile(request["source"], request["file"], "exec", dont_inherit=True), module.__dict__)
    found = getattr(module, request["name"], None)
    if not callable(getattr(found, "update", None)) or not callable(getattr(found, "start", None)):
        raise TypeError(f"{request['name']!r} is no estimator: it must have the methods start and update")
    if getattr(found, "kind", "estimator") != "estimator" or getattr(found, "task_keywords", None):
        raise TypeError("a process of its own runs only estimators, without task_keywords of their own")
    return found


def make_estimator(cls: Any, task: Any) -> Any:
    """Return an estimator of a class, made with the task if its constructor takes it."""
    from filtergym.evaluation.competitors.adapters import check_update_order, takes_problem

    check_update_order(cls)
    if not isinstance(cls, type):
        return cls
    return cls(task) if takes_problem(cls) else cls()


def run_program(words: list[str]) -> None:
    """Replace this process by a program, with exec."""
    for number in (13, 25):  # SIGPIPE and SIGXFSZ, which Python ignores
        ctypes.CDLL(None).signal(number, None)
    try:
        os.execvp(words[0], words)
    except OSError as error:
        os.write(2, f"{words[0]}: {error.strerror}\n".encode())
        os._exit(127)


def main(memory: str, *words: str) -> None:
    """Run a program or one estimator in a sandbox.

    Args:
        memory: limit of address space in bytes; 0: none. Only Linux applies it.
        words: the program and its arguments; without any an estimator is run.
    """
    apart = False
    if sys.platform == "linux":
        if int(memory):
            limit_resource("RLIMIT_AS", int(memory))
        libc = ctypes.CDLL(None, use_errno=True)
        apart = enter_namespaces(libc, NEW_PID if words else NEW_PID | NEW_OTHERS)
        libc.prctl(END_WITH_PARENT, TERMINATE, 0, 0, 0)
        for _ in range(1 + apart):  # the first one of a namespace only waits
            continue_in_child(libc, apart)
    run_program([*words]) if words else serve_estimator(apart)


def serve_estimator(apart: bool) -> None:
    """Serve one estimator in this restricted process over standard input and output."""
    import json

    questions, answers = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # an estimator's prints go to standard error, not into the answers
    request, hello = json.loads(questions.readline()), json.loads(questions.readline())
    gaps = restrict_process(request["readable"], request["listable"], apart)
    sys.path[:] = request["path"]
    sys.meta_path.insert(0, SharedModules(request["shared"]))
    import numpy

    try:
        own = make_estimator(load_estimator(request), make_task(hello, numpy))
    except Exception as error:  # a module is a program: it can raise anything
        response: dict[str, Any] = {"error": f"{type(error).__name__}: {error}"}
    else:
        response = {"filtergym": 1, "format": "float64"} | ({"warning": gaps} if gaps else {})
    answers.write(json.dumps(response).encode() + b"\n")
    answers.flush()
    frames = Frames(hello, numpy, questions)
    if "error" in response or (initial := frames.read("initial")) is None:
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
    main(*sys.argv[1:])
