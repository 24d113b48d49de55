"""Errors in a user's code, in one sentence with the line that raised them."""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...compiler.namespace import NotTraceable

PACKAGE = __name__.partition(".")[0]
PYTHON = str(Path(traceback.__file__).parent)
"""Folder of Python's own modules."""


def user_code_line(error: BaseException) -> str:
    """Return the last line of the user's code in a traceback as text, " (mine.py, line 12)"; "" if there is none.

    Code of this package and of installed libraries does not count.
    """
    found = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        module = frame.f_globals.get("__package__") or frame.f_globals.get("__name__", "")
        file = frame.f_code.co_filename
        installed = "site-packages" in file or file.startswith(("<", PYTHON))
        if module.partition(".")[0] != PACKAGE and not installed:
            found = f" ({Path(file).name}, line {line})"
    return found


@contextmanager
def explain_errors(what: str) -> Iterator[None]:
    """Context manager: turn errors in a user's code into a ValueError that names the line of that code.

    Args:
        what: beginning of the message.

    Raises:
        ValueError: for any error but that of code that cannot be traced.
    """
    try:
        yield
    except NotTraceable:
        raise
    except (Exception, SystemExit) as error:
        raise ValueError(f"{what}: {type(error).__name__}: {error}{user_code_line(error)}") from error
