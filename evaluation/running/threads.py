"""Restriction of numerical libraries to one thread.

Products of many small matrices are slower on several threads, and their division may change the last bit.
"""

import functools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from threadpoolctl import ThreadpoolController

SETTINGS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that libraries read when they are loaded."""
_INSIDE = ContextVar("inside", default=False)
"""Whether the running context already has one thread."""


@functools.lru_cache(1)
def _controller(modules: int) -> ThreadpoolController:
    """Return the controller of libraries' threads, cached by the number of modules: a search takes 1.5 ms."""
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Restrict BLAS and torch to one thread each inside the context, also where they are loaded inside it."""
    if _INSIDE.get():  # another search of the loaded libraries takes longer than some pieces of work
        yield
        return
    torch = sys.modules.get("torch")
    threads = None if torch is None else torch.get_num_threads()
    settings = {name: os.environ.get(name) for name in SETTINGS}
    os.environ.update(dict.fromkeys(SETTINGS, "1"))
    token = _INSIDE.set(True)
    try:
        with _controller(len(sys.modules)).limit(limits=1):
            if torch is not None and threads != 1:
                torch.set_num_threads(1)
            yield
    finally:
        _INSIDE.reset(token)
        if torch is not None and threads != 1:
            torch.set_num_threads(threads)
        for name, value in settings.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
