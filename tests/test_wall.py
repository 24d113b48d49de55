"""What can be reached from inside the wall, probe by probe, and why: of an isolated estimator and of a program."""

import ctypes
import os
import socket
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import filtergym
from filtergym.envs.contract.filter import Initial
from filtergym.envs.contract.task import Component
from filtergym.evaluation.competitors import isolated_estimator, program_process
from filtergym.evaluation.competitors.isolated_estimator import landlock_version
from filtergym.evaluation.competitors.isolation import isolate_source
from filtergym.evaluation.competitors.programs import Program

pytestmark = pytest.mark.skipif(
    landlock_version() < 6, reason="this system has no Landlock that knows of signals"
)
LAYERS = ("enter_namespaces", "filter_calls", "landlock_version")

# Each probe reaches for something and raises OSError or ImportError where it is refused. The table lists those which
# a competitor may do, and the reason. JUDGE is the process that runs it; PLACE a folder with a file of its own.
PROBES = """
import array, ctypes, importlib, mmap, os, resource, socket, threading, time

libc = ctypes.CDLL(None, use_errno=True)
libc.shmat.restype = ctypes.c_void_p
ARM = os.uname().machine == "aarch64"


def call(function, *arguments):
    found = function(*arguments)
    if found < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return found


def system(x86, arm, *arguments):
    return call(libc.syscall, arm if ARM else x86, *arguments)


def connect(place, protocol=0, kind=socket.SOCK_STREAM):
    family = socket.AF_UNIX if isinstance(place, str) else socket.AF_INET
    with socket.socket(family, kind, protocol) as channel:
        channel.settimeout(1.0)
        channel.connect(place)
        channel.send(b"?")


def listen(bound=False, protocol=0):
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM, protocol) as channel:
        if bound:
            channel.bind(("127.0.0.1", 0))
        channel.listen()


def fork(act=lambda: None):
    if (child := os.fork()) == 0:
        try:
            act()
        finally:
            os._exit(1)
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0:
        raise OSError("refused")


def own_signals():
    with open(OWN) as file:
        libc.fcntl.restype = ctypes.c_int
        call(libc.fcntl, file.fileno(), 8, JUDGE)


def own_file(act):
    with open(OWN) as file:
        act(file.fileno())


def limit():
    resource.prlimit(JUDGE, resource.RLIMIT_CORE, resource.prlimit(JUDGE, resource.RLIMIT_CORE))


def post():
    call(libc.mq_open, b"/filtergym-probe", os.O_CREAT | os.O_RDWR, 0o600, None)


def thread():
    own = threading.Thread(target=time.sleep, args=(0.0,))
    try:
        own.start()
    except RuntimeError as error:
        raise OSError(str(error))
    own.join()


V, NEW = PLACE + "/victim", PLACE + "/new"
TABLE = [
    # The truth, and what else is read.
    ("import the package", False, "it holds worlds and seeds", lambda: importlib.import_module("filtergym.envs")),
    ("read its files", False, "they hold the worlds", lambda: open(PACKAGE).read()),
    ("read the judge's words", False, "they hold the seed", lambda: open(f"/proc/{JUDGE}/cmdline").read()),
    ("read its environment", False, "keys are there", lambda: open(f"/proc/{JUDGE}/environ").read()),
    ("open its memory", False, "the truth is there", lambda: open(f"/proc/{JUDGE}/mem", "rb")),
    ("copy its memory", False, "the truth is there", lambda: copy_memory()),
    ("trace it", False, "the truth is there", lambda: call(libc.ptrace, 0x4206, JUDGE, 0, 0)),
    ("take its files", False, "results are there", lambda: system(438, 438, os.pidfd_open(JUDGE), 1, 0)),
    ("list another folder", False, "files of others", lambda: os.listdir(PLACE)),
    ("read another file", False, "files of others", lambda: open("/etc/passwd").read()),
    ("list shared memory", False, "files of others", lambda: os.listdir("/dev/shm")),
    ("size of another file", True, "no layer hides it; the truth is in no file", lambda: os.stat("/etc/passwd")),
    ("read its own module's folder", True, "modules lie there", lambda: open(OWN).read()),
    # What outlives the process, or changes what others have.
    ("write a file", False, "it would outlive the run", lambda: open(NEW, "w")),
    ("write beside its module", False, "it would outlive the run", lambda: open(OWN + ".new", "w")),
    ("write to /dev/shm", False, "it would outlive the run", lambda: open("/dev/shm/filtergym-probe", "w")),
    ("make a folder", False, "its name is a note", lambda: os.mkdir(NEW + "-folder")),
    ("empty a file", False, "files of others", lambda: os.truncate(V, 0)),
    ("link a file", False, "its name is a note", lambda: os.link(V, NEW + "-link")),
    ("rename a file", False, "its name is a note", lambda: os.rename(PLACE + "/renamed", NEW + "-name")),
    ("chmod", False, "bits are a note", lambda: os.chmod(V, 0o640)),
    ("chmod of an open file", False, "bits are a note", lambda: own_file(lambda f: os.fchmod(f, 0o640))),
    ("chown", False, "bits are a note", lambda: os.chown(V, os.getuid(), os.getgid())),
    ("utime", False, "times are a note", lambda: os.utime(V, (1, 1))),
    ("setxattr", False, "attributes are a note", lambda: os.setxattr(V, "user.note", b"1")),
    ("System V shared memory", False, "it outlives the run", lambda: call(libc.shmget, 0x5EED, 4096, 0o1600)),
    ("System V messages", False, "they outlive the run", lambda: call(libc.msgget, 0x5EED, 0o1600)),
    ("System V semaphores", False, "they outlive the run", lambda: call(libc.semget, 0x5EED, 1, 0o1600)),
    ("POSIX messages", False, "they outlive the run", post),
    ("keyring of the user", False, "it outlives the run", lambda: system(248, 217, b"user", b"probe", b"1", 1, -4)),
    ("keyring of the session", False, "it outlives the run", lambda: system(248, 217, b"user", b"probe", b"1", 1, -3)),
    # Other processes.
    ("start a program", False, "its time is not counted", lambda: fork(lambda: os.execv("/bin/true", ["true"]))),
    ("fork", False, "its time is not counted", lambda: fork(lambda: os._exit(0))),
    ("signal the judge", False, "it ends the run of all", lambda: os.kill(JUDGE, 0)),
    ("be signalled for it", False, "it ends the run of all", own_signals),
    ("limit the judge", False, "it ends the run of all", limit),
    ("slow the judge", False, "times of others", lambda: os.setpriority(0, JUDGE, os.getpriority(0, JUDGE))),
    ("move the judge", False, "times of others", lambda: os.sched_setaffinity(JUDGE, os.sched_getaffinity(0))),
    ("raise its own limit", False, "memory is limited", lambda: resource.setrlimit(9, (1 << 60, 1 << 60))),
    ("a thread", True, "its time is counted", thread),
    # The world outside.
    ("connect by TCP", False, "notes from elsewhere", lambda: connect(("127.0.0.1", PORT))),
    ("connect by MPTCP", False, "notes from elsewhere", lambda: connect(("127.0.0.1", PORT), 262)),
    ("send by UDP", False, "notes from elsewhere", lambda: connect(("127.0.0.1", 9), kind=socket.SOCK_DGRAM)),
    ("bind and listen", False, "notes from elsewhere", lambda: listen(True)),
    ("listen", False, "notes from elsewhere", listen),
    ("listen by MPTCP", False, "notes from elsewhere", lambda: listen(False, 262)),
    ("a socket in a folder", False, "services of others", lambda: connect(PLACE + "/socket")),
    ("an abstract socket", False, "services of others", lambda: connect(ABSTRACT)),
    # The kernel's doors to all of these.
    ("io_uring", False, "it calls past a filter of calls", lambda: system(425, 425, 1, bytes(120))),
    ("a user namespace", False, "rights that find faults of kernels", lambda: call(libc.unshare, 0x10000000)),
    # What estimators need.
    ("memory", True, "arrays", lambda: mmap.mmap(-1, 1 << 20)),
    ("a clock and random numbers", True, "filters draw", lambda: (time.time(), os.urandom(8))),
]


def copy_memory():
    own = ctypes.create_string_buffer(8)
    here = (ctypes.c_size_t * 2)(ctypes.addressof(own), 8)
    there = (ctypes.c_size_t * 2)(ADDRESS, 8)
    call(libc.process_vm_readv, JUDGE, here, 1, there, 1, 0)


def allowed(probe):
    try:
        probe()
    except (OSError, ImportError, ValueError, AttributeError):  # ValueError of limits; or the C library lacks it
        return "0"
    return "1"


class Probe:
    start = update = None.__init__

    def __init__(self):
        raise RuntimeError("".join(allowed(probe) for _, _, _, probe in TABLE))
"""


# What a program may not do to the process that runs it: its other rights are those of the user.
OF_PROGRAMS = (
    "copy its memory", "trace it", "take its files", "signal the judge", "be signalled for it", "limit the judge",
    "slow the judge", "move the judge",
)  # fmt: skip
ANSWER = """
import json
tried = [probe for name, _, _, probe in TABLE if name in NAMES]
print(json.dumps({"error": "".join(map(allowed, tried))}), flush=True)
"""


def without(folder, *layers):
    """Write what starts a process on a system that has not these layers of the wall; returns its path."""
    text = Path(isolated_estimator.__file__).read_text(encoding="utf-8")
    for layer in layers:
        text = text.replace(f"def {layer}(", f"{layer} = lambda *_: False\n\n\ndef _{layer}(")
    (folder / "launcher.py").write_text(text, encoding="utf-8")
    return str(folder / "launcher.py")


@pytest.fixture
def absent(tmp_path, monkeypatch):
    """Take layers away."""
    return lambda *layers: monkeypatch.setattr(program_process, "LAUNCHER", without(tmp_path, *layers))


@pytest.fixture
def probes(tmp_path):
    """Text of the probes and what they reach for, and their table."""
    place, own = tmp_path / "place", tmp_path / "own"
    place.mkdir()
    own.mkdir()
    for path in (place / "victim", place / "renamed", own / "mine.py"):
        path.touch()
    target, abstract = ctypes.create_string_buffer(8), f"\0filtergym-probe-{os.getpid()}"
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        for address in (f"{place}/socket", abstract):
            other = stack.enter_context(socket.socket(socket.AF_UNIX))
            other.bind(address)
            other.listen()
        names = {
            "PACKAGE": filtergym.__file__, "PLACE": str(place), "OWN": str(own / "mine.py"), "JUDGE": os.getpid(),
            "PORT": server.getsockname()[1], "ABSTRACT": abstract, "ADDRESS": ctypes.addressof(target),
        }  # fmt: skip
        text = "".join(f"{name} = {value!r}\n" for name, value in names.items()) + PROBES
        space = {}
        exec(text, space)
        yield text, space["TABLE"], own / "mine.py"


def answer(program):
    """The first answer of a program about one track: its mean, or the sentence with which it takes no part."""
    components = [Component("c", "m")]
    task = SimpleNamespace(
        id="mine/Task-v0", components=components, groups={}, companions=(), parameters=None, closes_loop=False
    )
    initial = Initial(np.ones((1, 8)), np.ones((1, 1, 8)))
    estimator = program(task)
    memory = estimator.start(initial, 8)
    try:
        return estimator.update(memory, initial)[0][0, 0]
    except ValueError as error:
        return str(error)
    finally:
        estimator.end()


@pytest.mark.parametrize("layers", [(), LAYERS[:1]], ids=["all layers", "no namespaces"])
def test_the_table_of_probes(layers, absent, probes):
    """A filter of calls refuses by itself what namespaces do, so where they are not allowed nothing opens."""
    absent(*layers)
    text, table, file = probes
    shown = answer(isolate_source(text, "Probe", "probe", file)).rpartition(" ")[2]
    found = {name: tried == "1" for (name, *_), tried in zip(table, shown, strict=True)}
    assert found == {name: expected for name, expected, *_ in table}
    assert len(found) > 40


PROPHET = """
import ctypes
import numpy as np


class Prophet:
    def start(self, initial, N):
        libc = ctypes.CDLL(None)
        libc.shmat.restype = ctypes.c_void_p
        place = libc.shmget(KEY, 4096, 0o1600)
        self.notes = (ctypes.c_double * 8).from_address(libc.shmat(place, None, 0)) if place >= 0 else [0.0] * 8
        return initial

    def update(self, memory, measurement):
        self.notes[0] += 1.0
        return self.notes[0] * memory.mean, memory.covariance, memory
"""


@pytest.mark.parametrize("layers", [(), LAYERS[:1], LAYERS[1:]], ids=["all layers", "filter", "namespaces"])
def test_a_prophet_knows_nothing_in_its_second_run(layers, absent):
    absent(*layers)
    prophet = isolate_source(f"KEY = {os.getpid()}\n{PROPHET}", "Prophet", "prophet")
    if layers == LAYERS[1:]:
        with pytest.warns(
            UserWarning, match="the isolation is incomplete, without Landlock and a filter of system calls"
        ):
            assert [answer(prophet), answer(prophet)] == [1.0, 1.0]
    else:
        assert [answer(prophet), answer(prophet)] == [1.0, 1.0]


@pytest.mark.parametrize(
    ("layers", "without", "could"),
    [
        (LAYERS[1:2], "a filter of system calls", "leave notes in times and modes of files and in keyrings"),
        (LAYERS[2:], "Landlock", "read any file, the package's among them"),
        (
            LAYERS[:2],
            "a filter of system calls and namespaces",
            "leave notes in times .*, and end or slow this",
        ),
        (
            LAYERS,
            "Landlock and a filter of system calls and namespaces",
            "read any file.*, write files, leave notes",
        ),
    ],
)
def test_what_stays_open_is_a_sentence_before_the_run(layers, without, could, absent):
    absent(*layers)
    honest = PROPHET.replace("libc.shmget(KEY, 4096, 0o1600)", "-1")
    with pytest.warns(UserWarning, match=f"the isolation is incomplete, without {without}: it could {could}"):
        assert answer(isolate_source(honest, "Prophet", "honest")) == 1.0


def test_a_program_reaches_no_other_process(probes, tmp_path):
    (tmp_path / "reach.py").write_text(f"{probes[0]}\nNAMES = {OF_PROGRAMS!r}\n{ANSWER}")
    program = Program(f"{sys.executable} {tmp_path / 'reach.py'}")
    assert answer(program).rpartition(" ")[2] == "0" * len(OF_PROGRAMS)


@pytest.mark.filterwarnings("ignore:program .* has ended")
def test_a_program_that_could_is_announced(tmp_path, absent):
    (tmp_path / "hello.py").write_text('print(\'{"filtergym": 1, "format": "json"}\', flush=True)\ninput()')
    absent("enter_namespaces")
    with pytest.warns(UserWarning, match="no PID namespace here: it could end or slow this process"):
        answer(Program(f"{sys.executable} {tmp_path / 'hello.py'}"))


BUSY = """
import os, sys, time


def begin(act):
    if os.fork() == 0:
        act()
        os._exit(0)


def burn(afterwards=0.0):
    until = time.process_time() + 0.1
    while time.process_time() < until:
        pass
    os.write(writing, b"!")
    time.sleep(afterwards)


sys.stdin.readline()
reading, writing = os.pipe()
begin(burn)
begin(lambda: begin(burn))
os.wait(), os.wait()
begin(lambda: burn(100.0))
for _ in range(3):
    os.read(reading, 1)
print(flush=True)
time.sleep(100.0)
"""


@pytest.mark.parametrize("layers", [(), LAYERS[:1]], ids=["namespaces", "none"])
def test_processor_time_of_children_is_counted(layers, absent, monkeypatch):
    """Of one that has ended, of one whose parent has ended, and of one that lives."""
    absent(*layers)
    monkeypatch.setattr(program_process, "END_SECONDS", 0.1)
    process = program_process.ProgramProcess([sys.executable, "-c", BUSY], program_process.Limits())
    process.exchange(b"?\n", None, 10)
    until = time.monotonic() + 5.0
    while process.processor_seconds < 0.25 and time.monotonic() < until:  # until its parent has seen each end
        time.sleep(0.01)
    assert process.processor_seconds > 0.25
