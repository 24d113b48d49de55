"""A pytest plugin that hides what Windows lacks, for tests of the core there: `make test-without-unix`.

Modules of Unix cannot be imported, and functions of `os` that fork or signal groups are absent. Libraries that were
loaded before keep what they have.
"""

import fcntl
import os
import sys
import types

import joblib  # noqa: F401  # its processes are started as Unix does
import numpy  # noqa: F401
import pandas  # noqa: F401
import platformdirs  # noqa: F401


def locking(handle, mode, count):
    """Lock the first bytes of a file for its handle, or fail, as that of Windows does."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise PermissionError(13, "Permission denied") from error


msvcrt = types.ModuleType("msvcrt")
msvcrt.locking, msvcrt.LK_NBLCK = locking, 2
sys.modules["msvcrt"] = msvcrt
for module in ("fcntl", "resource", "pwd", "grp", "termios", "_posixsubprocess"):
    sys.modules[module] = None  # type: ignore[assignment]
for function in ("fork", "forkpty", "killpg", "sched_getaffinity", "set_blocking", "mkfifo"):
    if hasattr(os, function):
        delattr(os, function)
