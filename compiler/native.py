"""Compilation of programs to machine code for the current processor, with a cache."""

import contextvars
import ctypes
import functools
import hashlib
import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy

from . import cache, emission
from .block import LANES, block_for, block_of
from .emission import emit, product_symbol, product_text
from .library import Library, fastest_library
from .program import LOCK, StraightLineProgram

AVAILABLE = importlib.util.find_spec("llvmlite") is not None
"""Whether programs can be compiled: llvmlite is installed."""
_ENGINES: list[Any] = []
"""LLVM engines that own the machine code; they are never freed, since the code may be called at any time."""


@functools.cache
def llvm() -> ModuleType:
    """Return the module ``llvmlite.binding``, initialised for this processor.

    Raises:
        ImportError: without llvmlite.
    """
    import llvmlite.binding as binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding


PROCESSOR = "FILTERGYM_COMPILER_PROCESSOR"
"""Environment variable with an older processor to whose instructions the code is limited, as ``NAME,+FEATURE,...``,
see :func:`processor`.
"""


def processor() -> tuple[str, str]:
    """Return the name and the features of the target processor, as LLVM writes them.

    It is this one, or ``FILTERGYM_COMPILER_PROCESSOR``, such as ``haswell,+avx2`` or ``x86-64``. Features
    beside a name select the vector functions (:func:`~.library.fastest_library`).

    Raises:
        ValueError: for a feature without ``+`` or ``-``.
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
    return llvm().get_host_cpu_name(), llvm().get_host_cpu_features().flatten()


def _target(level: int = 1) -> Any:
    name, features = processor()
    return llvm().Target.from_default_triple().create_target_machine(cpu=name, features=features, opt=level)


class Setting(NamedTuple):
    """Settings of code generation, such as optimisation level; results have the same bits under each."""

    lanes: int
    """Number of lanes of a block."""
    part: int
    """Number of statements of a part."""
    level: int
    """LLVM's optimisation level."""
    loops: bool = False
    """Whether a long program is computed in loops."""


def quick_setting(features: str, has_products: bool) -> Setting:
    """Return the settings for the shortest compilation: no optimisation, loops, small blocks.

    With products of matrices the blocks are those of the fastest code: in half of a block a product takes twice as
    long.
    """
    return Setting(LANES if has_products else block_for(features).lanes, 150, 0, loops=not has_products)


OPTIMISED = Setting(LANES, 200, 1)
"""The setting with the fastest code; where a register has four lanes, a block is two registers."""
HOT = 2_000_000
"""Number of lanes after which optimisation is worth its time: three to five times that of the quick setting, for code
that takes up to a third less. Both times are proportional to the program's length, so this number does not depend on
it.
"""
IN_LOOPS = 10
"""Divisor of :data:`HOT` where the quick code is loops, which take 1.4 to 2.2 times as long: by then they have lost
about the time in which a straight line is compiled, so neither choice loses more than that."""
LONG, LONGEST = 20_000, 100_000
"""Numbers of steps from which on optimisation saves no time, since the numbers exceed the nearest caches; and from
which on a straight line saves none either, since its code exceeds them.
"""


def better_setting(quick: Setting, steps: int, in_loops: bool) -> Setting | None:
    """Return the settings for the fastest code; None if the quick settings already give it.

    ``steps`` is the number of steps of the program, ``in_loops`` whether the quick code is loops.
    """
    if steps < LONG:
        return OPTIMISED
    return quick._replace(loops=False) if in_loops and steps < LONGEST else None


Native = Callable[[int, int, int], None]
"""Machine code of a program, a function of the address of the table of arguments, the first lane and the end of the
lanes.
"""
NATIVE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
"""ctypes signature of :data:`Native`."""
PRODUCT = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3, ctypes.c_int64, ctypes.c_int64)
"""ctypes signature of the matrix-vector product, see :func:`~.emission.product_text`."""


def address_of_code(code: Any) -> int:
    """Return the memory address of a native function."""
    return ctypes.cast(code, ctypes.c_void_p).value or 0


_EAGER: contextvars.ContextVar[bool] = contextvars.ContextVar("eager", default=False)
"""Whether programs are optimised at once, in the present context."""


@contextmanager
def optimised_code() -> Iterator[None]:
    """Context manager: optimise programs in a :class:`~.sequence.CallSequence` at once, not after many lanes."""
    token = _EAGER.set(True)
    try:
        yield
    finally:
        _EAGER.reset(token)


class Code:
    """Machine code of a program: compiled quickly for its first run, optimised after many lanes.

    Args:
        make: function that compiles the code quickly.
        optimise: function that compiles optimised code, where that is faster.
        hot: number of lanes after which the code is optimised.
    """

    def __init__(
        self, make: Callable[[], Native], optimise: Callable[[], Native] | None = None, hot: int = 0
    ) -> None:
        self._make, self._optimise, self._hot, self._lanes = make, optimise, hot, 0
        self._run: Native | None = None

    def expect(self, lanes: int, in_sequence: bool = False) -> Native:
        """Return the machine code for a run over some lanes, optimised if it has run often enough.

        Args:
            lanes: number of lanes of the run, summed over its steps.
            in_sequence: whether many steps are one native call, to which :func:`optimised_code` applies.
        """
        self._lanes += lanes
        if self._optimise is not None and (self._lanes > self._hot or (in_sequence and _EAGER.get())):
            optimise, self._optimise = self._optimise, None
            self._run = optimise()
        elif self._run is None:
            self._run = self._make()
        return self._run


def native(program: StraightLineProgram, lane_first: Sequence[bool], library: Library | None = None) -> Code:
    """Return the machine code of a program, shared by all programs that differ only in constants.

    An argument that is ``lane_first`` has layout ``(N, rows)``. The default library is the fastest for this processor.
    """
    with LOCK:
        binding, (_, features) = llvm(), processor()
        library = library or fastest_library(features)
        symbols = {name: (own.symbol, own.lanes) for name, own in library.functions.items()}
        has_products = "product" in program.steps.operations
        quick = quick_setting(features, has_products)
        in_loops = quick.loops and len(program.steps) >= emission.LONG
        better = better_setting(quick, len(program.steps), in_loops)
        made_of = _text_of(program), repr((list(lane_first), symbols)), _own_text()
        key, better_key = (_key(*made_of, repr(setting)) for setting in (quick, better))
        if key not in _CODES:
            for own in library.functions.values():
                binding.add_symbol(own.symbol, own.address)

            def code(setting: Setting, key: str) -> Native:
                with LOCK:
                    block = block_of(setting.lanes)
                    if has_products:
                        product = native_text(product_text(block), PRODUCT)
                        binding.add_symbol(product_symbol(block), address_of_code(product))
                    form = block, setting.part, setting.loops
                    return _load(
                        key, lambda: emit(program, lane_first, library, *form), NATIVE, setting.level
                    )

            make, optimise = functools.partial(code, quick, key), None
            if better is not None:
                optimise = functools.partial(code, better, better_key)
                if cache.contains(better_key):
                    make, optimise = optimise, None
            _CODES[key] = Code(make, optimise, HOT // IN_LOOPS if in_loops else HOT)
        return _CODES[key]


def native_text(text: str, signature: Any = NATIVE, level: int = 1) -> Any:
    """Compile an LLVM text without library functions; return it as a native function.

    Its results are the same on every processor. ``signature`` is that of ``@program`` for ctypes, by default of
    :data:`Native`.
    """
    with LOCK:
        key = _key(text, str(level))
        if key not in _TEXTS:
            _TEXTS[key] = _load(key, lambda: text, signature, level)
        return _TEXTS[key]


def _key(*texts: str) -> str:
    return cache.key(*texts, *processor(), repr(llvm().llvm_version_info))


def _text_of(program: StraightLineProgram) -> str:
    """Return a text that identifies a program up to its constants; faster than its LLVM text."""
    steps, results = program.steps, numpy.array(program.results, dtype=numpy.int64)
    columns = (steps.kinds, steps.begins, steps.arguments, steps.logical, results)
    return " ".join(steps.names) + hashlib.sha256(b"".join(map(numpy.ndarray.tobytes, columns))).hexdigest()


@functools.cache
def _own_text() -> str:
    return "".join(path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("*.py")))


def _load(key: str, write: Callable[[], str], signature: Any, level: int = 1) -> Any:
    """Return the native function of a cache key; if it is not cached, compile the text that ``write`` returns."""
    binding = llvm()
    code = cache.load(key)
    if code is None:
        module = binding.parse_assembly(write())
        code = _target(level).emit_object(module)
        cache.store(key, code)
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _target())
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    return signature(engine.get_function_address("program"))


_CODES: dict[str, Code] = {}
"""Codes of the programs that this process has loaded, by the key of the quick code."""
_TEXTS: dict[str, Any] = {}
"""Native functions of LLVM texts, by key."""
