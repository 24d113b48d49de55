"""Programs as code of the processor at hand."""

import ctypes
import functools
import importlib.util
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from . import cache
from .block import block_for
from .emission import emit
from .library import Library, fastest
from .program import LOCK, Program

AVAILABLE = importlib.util.find_spec("llvmlite") is not None
"""Whether programs can be compiled here."""
_ENGINES: list[Any] = []
"""What owns the code; it is never given back, as somebody may be about to call it."""


@functools.cache
def llvm() -> ModuleType:
    """Return the binding of llvmlite, ready for this processor.

    Raises:
        ImportError: without llvmlite.
    """
    import llvmlite.binding as binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding


PROCESSOR = "FILTERGYM_COMPILER_PROCESSOR"
"""Environment variable: an older processor whose instructions to keep to, as ``NAME,+FEATURE,...``; see
:func:`processor`."""


def processor() -> tuple[str, str]:
    """Name and features of the processor that code is made for, as LLVM calls them: this one, or what
    ``FILTERGYM_COMPILER_PROCESSOR`` names, such as ``haswell,+avx2`` or ``x86-64``.

    LLVM knows the features of a processor that it has a name for; those that are written here too decide which vector
    functions are called (:func:`~.library.fastest`).

    Raises:
        ValueError: for a feature that is neither switched on nor off.
    """
    chosen = os.environ.get(PROCESSOR)
    if not chosen:
        return _host()
    name, *features = chosen.split(",")
    for feature in features:
        if feature[:1] not in ("+", "-"):
            raise ValueError(f"{PROCESSOR}={chosen!r}: expected +FEATURE or -FEATURE, got {feature!r}")
    return name, ",".join(features)


@functools.cache
def _host() -> tuple[str, str]:
    """Name and features of this processor, which LLVM finds out anew each time."""
    return llvm().get_host_cpu_name(), llvm().get_host_cpu_features().flatten()


LONG = 3000
"""Steps from which on LLVM does not optimise a program: measured, it takes a quarter of the time, and the code is as
fast, because it waits for memory."""


def _target(level: int = 1) -> Any:
    name, features = processor()
    return llvm().Target.from_default_triple().create_target_machine(cpu=name, features=features, opt=level)


Native = Callable[[int, int, int], None]
"""Called with the address of the table of arguments, and with the lanes from where to where."""
NATIVE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
"""The same for ctypes."""


def native(program: Program, lane_first: Sequence[bool], library: Library | None = None) -> Native:
    """Return code that runs a program.

    Args:
        program: what it computes.
        lane_first: of every argument whether it is written as ``(N, rows)``.
        library: where functions come from; default: the fastest for this processor.
    """
    with LOCK:
        binding, (_, features) = llvm(), processor()
        library = library or fastest(features)
        symbols = {name: (own.symbol, own.lanes) for name, own in library.functions.items()}
        # Its text takes longer to write than this to say, and other numbers leave the steps as they are.
        steps, results = ([tuple(entry) for entry in entries] for entries in (program.steps, program.results))
        made_of = repr((steps, results, list(lane_first), symbols))
        key = _key(made_of, _own_text())
        if key not in _LIBRARIES:
            for own in library.functions.values():
                binding.add_symbol(own.symbol, own.address)
            level = int(len(program.steps) < LONG)
            block = block_for(features)
            _LIBRARIES[key] = _load(key, lambda: emit(program, lane_first, library, block), NATIVE, level)
        return _LIBRARIES[key]


def native_text(text: str, signature: Any = NATIVE) -> Any:
    """Return code of a text that calls no function by its name: only what every processor computes alike.

    Args:
        text: of LLVM, with an entry ``@program``.
        signature: of the entry, as ctypes writes it; default: ``(table, first, last)``, as of :data:`Native`.

    Raises:
        ImportError: without llvmlite.
    """
    with LOCK:
        key = _key(text)
        if key not in _LIBRARIES:
            _LIBRARIES[key] = _load(key, lambda: text, signature)
        return _LIBRARIES[key]


def _key(*texts: str) -> str:
    """Name of the code that is made of some texts for this processor."""
    return cache.key(*texts, *processor(), repr(llvm().llvm_version_info))


@functools.cache
def _own_text() -> str:
    """Text of this compiler, which decides what becomes of a program."""
    return "".join(path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("*.py")))


def _load(key: str, write: Callable[[], str], signature: Any, level: int = 1) -> Any:
    """Load the code of a text, translated or found in the cache."""
    binding = llvm()
    code = cache.load(key)
    if code is None:
        module = binding.parse_assembly(write())
        module.verify()
        code = _target(level).emit_object(module)
        cache.keep(key, code)
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _target())
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    return signature(engine.get_function_address("program"))


_LIBRARIES: dict[str, Native] = {}
"""By its key: code that this process has loaded."""
