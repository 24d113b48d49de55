"""What can be reached from inside the wall, probe by probe, and why: of an isolated estimator and of a program."""

import os
import socket
import sys
from pathlib import Path

import numpy as np
import pytest

from filtergym.evaluation.competitors.isolation import isolate_source

# Each probe reaches for something and raises OSError or ImportError where it is refused. The table says which of them
# a competitor may do, and the reason. JUDGE is the process that runs it; PLACE a folder with a file of its own.
PROBES = '''
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


def connect(kind, protocol, place, family=socket.AF_INET):
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
    ("size of another file", True, "no layer of Linux hides it; the truth is in no file", lambda: os.stat("/etc/passwd")),
    ("read its own module's folder", True, "modules lie there", lambda: open(OWN).read()),
    # What outlives the process, or changes what others have.
    ("write a file", False, "it would outlive the run", lambda: open(NEW, "w")),
    ("write beside its module", False, "it would outlive the run", lambda: open(OWN + ".new", "w")),
    ("write to /dev/shm", False, "it would outlive the run", lambda: open("/dev/shm/filtergym-probe", "w")),
    ("make a folder", False, "its name is a note", lambda: os.mkdir(NEW)),
    ("empty a file", False, "files of others", lambda: os.truncate(V, 0)),
    ("link a file", False, "its name is a note", lambda: os.link(V, NEW)),
    ("rename a file", False, "its name is a note", lambda: os.rename(V, NEW)),
    ("chmod", False, "bits are a note", lambda: os.chmod(V, 0o640)),
    ("chmod of an open file", False, "bits are a note", lambda: own_file(lambda f: os.fchmod(f, 0o640))),
    ("chown", False, "bits are a note", lambda: os.chown(V, os.getuid(), os.getgid())),
    ("utime", False, "times are a note", lambda: os.utime(V, (1, 1))),
    ("setxattr", False, "attributes are a note", lambda: os.setxattr(V, "user.note", b"1")),
    ("System V shared memory", False, "it outlives the run", lambda: call(libc.shmget, 0x5EED, 4096, 0o1600)),
    ("System V messages", False, "they outlive the run", lambda: call(libc.msgget, 0x5EED, 0o1600)),
    ("System V semaphores", False, "they outlive the run", lambda: call(libc.semget, 0x5EED, 1, 0o1600)),
    ("POSIX messages", False, "they outlive the run", lambda: call(libc.mq_open, b"/seed", os.O_CREAT | os.O_RDWR, 0o600, None)),
    ("keyring of the user", False, "it outlives the run", lambda: system(248, 217, b"user", b"probe", b"1", 1, -4)),
    ("keyring of the session", False, "it outlives the run", lambda: system(248, 217, b"user", b"probe", b"1", 1, -3)),
    # Other processes.
    ("start a program", False, "its time is not counted", lambda: fork(lambda: os.execv("/bin/true", ["true"]))),
    ("fork", False, "its time is not counted", lambda: fork(lambda: os._exit(0))),
    ("signal the judge", False, "it ends the run of all", lambda: os.kill(JUDGE, 0)),
    ("be signalled for it", False, "it ends the run of all", own_signals),
    ("limit the judge", False, "it ends the run of all", lambda: resource.prlimit(JUDGE, resource.RLIMIT_CORE, resource.prlimit(JUDGE, resource.RLIMIT_CORE))),
    ("slow the judge", False, "times of others", lambda: os.setpriority(os.PRIO_PROCESS, JUDGE, os.getpriority(os.PRIO_PROCESS, JUDGE))),
    ("move the judge", False, "times of others", lambda: os.sched_setaffinity(JUDGE, os.sched_getaffinity(0))),
    ("raise its own limit", False, "memory is limited", lambda: resource.setrlimit(resource.RLIMIT_AS, (1 << 60, 1 << 60))),
    ("a thread", True, "its time is counted", thread),
    # The world outside.
    ("connect by TCP", False, "truth or notes from elsewhere", lambda: connect(socket.SOCK_STREAM, 0, ("127.0.0.1", PORT))),
    ("connect by MPTCP", False, "truth or notes from elsewhere", lambda: connect(socket.SOCK_STREAM, 262, ("127.0.0.1", PORT))),
    ("send by UDP", False, "notes elsewhere", lambda: connect(socket.SOCK_DGRAM, 0, ("127.0.0.1", 9))),
    ("bind and listen", False, "notes from elsewhere", lambda: listen(True)),
    ("listen", False, "notes from elsewhere", listen),
    ("listen by MPTCP", False, "notes from elsewhere", lambda: listen(False, 262)),
    ("a socket in a folder", False, "services of others", lambda: connect(socket.SOCK_STREAM, 0, PLACE + "/socket", socket.AF_UNIX)),
    ("an abstract socket", False, "services of others", lambda: connect(socket.SOCK_STREAM, 0, ABSTRACT, socket.AF_UNIX)),
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
'''
