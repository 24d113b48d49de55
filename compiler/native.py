"""Programs as code of the processor at hand."""

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
from .library import Library, fastest
from .program import LOCK, StraightLineProgram

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


def _target(level: int = 1) -> Any:
    name, features = processor()
    return llvm().Target.from_default_triple().create_target_machine(cpu=name, features=features, opt=level)


class Setting(NamedTuple):
    """How a program becomes code; its results have the same bits in every setting."""

    lanes: int
    """Of a block."""
    part: int
    """Statements of a part."""
    level: int
    """Of LLVM's optimisation of code."""
    loops: bool = False
    """Whether a long program is computed in loops."""


def quick_setting(features: str, has_products: bool) -> Setting:
    """Return the setting that takes LLVM the least time: no optimisation, loops, blocks of one register; with products
    of matrices those of the fastest code, as a product takes twice as long in half of a block.

    Args:
        features: of the processor.
        has_products: whether the program multiplies with matrices.
    """
    return Setting(LANES if has_products else block_for(features).lanes, 150, 0, loops=not has_products)


OPTIMISED = Setting(LANES, 200, 1)
"""The setting with the fastest code; where a register holds four lanes, two of them make a block."""
HOT = 2_000_000
"""Lanes after which a program is worth the time that optimisation takes: three to five times that of the quick setting,
for code that takes up to a third less. Both are in proportion to the program's length, so the lanes are not."""
IN_LOOPS = 10
"""How many times sooner that is so where the quick code is loops, which take 1.4 to 2.2 times as long: by then they
have lost about the time in which a straight line is compiled, and whoever stops or goes on loses no more."""
LONG, LONGEST = 20_000, 100_000
"""Steps of a program from which on optimisation saves nothing, because its numbers do not fit into the nearest caches;
and from which on a straight line saves nothing either, because its code does not."""


def better_setting(quick: Setting, steps: int, in_loops: bool) -> Setting | None:
    """Return the setting of the fastest code; None: it is the quick one.

    Args:
        quick: the quick one.
        steps: of the program.
        in_loops: whether the quick code is loops.
    """
    if steps < LONG:
        return OPTIMISED
    return quick._replace(loops=False) if in_loops and steps < LONGEST else None


Native = Callable[[int, int, int], None]
"""Called with the address of the table of arguments, and with the lanes from where to where."""
NATIVE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
"""The same for ctypes."""
PRODUCT = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3, ctypes.c_int64, ctypes.c_int64)
"""Of the product of a matrix, see :func:`~.emission.product_text`."""


def address_of_code(code: Any) -> int:
    """Return the address of a native function."""
    return ctypes.cast(code, ctypes.c_void_p).value or 0


_EAGER: contextvars.ContextVar[bool] = contextvars.ContextVar("eager", default=False)
"""Whether programs are optimised before they have run long."""


@contextmanager
def optimised_code() -> Iterator[None]:
    """Let programs that run inside in a :class:`~.sequence.CallSequence` be optimised at once: times depend neither
    on a cache nor on how long they have run then.
    """
    token = _EAGER.set(True)
    try:
        yield
    finally:
        _EAGER.reset(token)


class Code:
    """Code of a program, made when it is first to run.

    A program is compiled quickly first, and better once it has run over many lanes, where that gains anything.

    Args:
        make: makes the code.
        optimise: makes better code; None: there is none.
        hot: lanes after which it is made.
    """

    def __init__(
        self, make: Callable[[], Native], optimise: Callable[[], Native] | None = None, hot: int = 0
    ) -> None:
        self._make, self._optimise, self._hot, self._lanes = make, optimise, hot, 0
        self._run: Native | None = None

    def expect(self, lanes: int, in_sequence: bool = False) -> Native:
        """Return the code for running over so many lanes: better code where it has become worth its time.

        Args:
            lanes: in all steps.
            in_sequence: whether many steps are one native call, which is what :func:`optimised_code` is about.
        """
        self._lanes += lanes
        if self._optimise is not None and (self._lanes > self._hot or (in_sequence and _EAGER.get())):
            optimise, self._optimise = self._optimise, None
            self._run = optimise()
        elif self._run is None:
            self._run = self._make()
        return self._run


def native(program: StraightLineProgram, lane_first: Sequence[bool], library: Library | None = None) -> Code:
    """Return the code of a program; one for all programs that differ in nothing but constants.

    Args:
        program: what it computes.
        lane_first: of every argument whether it is written as ``(N, rows)``.
        library: where functions come from; default: the fastest for this processor.
    """
    with LOCK:
        binding, (_, features) = llvm(), processor()
        library = library or fastest(features)
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
                if cache.holds(better_key):
                    make, optimise = optimise, None
            _CODES[key] = Code(make, optimise, HOT // IN_LOOPS if in_loops else HOT)
        return _CODES[key]


def native_text(text: str, signature: Any = NATIVE, level: int = 1) -> Any:
    """Return code of a text that calls no function by its name: only what every processor computes alike.

    Args:
        text: of LLVM, with an entry ``@program``.
        signature: of the entry, as ctypes writes it; default: ``(table, first, last)``, as of :data:`Native`.
        level: of LLVM's optimisation of code.

    Raises:
        ImportError: without llvmlite.
    """
    with LOCK:
        key = _key(text, str(level))
        if key not in _TEXTS:
            _TEXTS[key] = _load(key, lambda: text, signature, level)
        return _TEXTS[key]


def _key(*texts: str) -> str:
    """Return the name of the code that is made of some texts for this processor."""
    return cache.key(*texts, *processor(), repr(llvm().llvm_version_info))


def _text_of(program: StraightLineProgram) -> str:
    """Return the text that tells programs apart that have other steps or results: it takes less time than that
    which is emitted, and other numbers leave it as it is.
    """
    steps, results = program.steps, numpy.array(program.results, dtype=numpy.int64)
    columns = (steps.kinds, steps.begins, steps.arguments, steps.logical, results)
    return " ".join(steps.names) + hashlib.sha256(b"".join(map(numpy.ndarray.tobytes, columns))).hexdigest()


@functools.cache
def _own_text() -> str:
    """Return the text of this compiler, which decides what becomes of a program."""
    return "".join(path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("*.py")))


def _load(key: str, write: Callable[[], str], signature: Any, level: int = 1) -> Any:
    """Load the code of a text, translated or found in the cache."""
    binding = llvm()
    code = cache.load(key)
    if code is None:
        module = binding.parse_assembly(write())
        code = _target(level).emit_object(module)
        cache.keep(key, code)
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _target())
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    return signature(engine.get_function_address("program"))


_CODES: dict[str, Code] = {}
"""Code of programs that this process has loaded, by the key of the quick one."""
_TEXTS: dict[str, Any] = {}
"""Code of texts, by its key."""
