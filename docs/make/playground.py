"""The playground's filters: exported C, unchanged, compiled to WebAssembly.

``pip install ziglang``, then ``python docs/make playground`` writes ``docs/playground/NAME.wasm``. The first page
contains them as text, since a page that is opened from the disk may not read files. Where zig's C compiler is not
installed, the committed files replace them.
"""

import base64
import importlib.util
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from filtergym.baselines.problem import problem_of
from filtergym.exports.c_filter import file_stem
from filtergym.exports.c_source import export_c
from filtergym.exports.request import request_export

FOLDER = Path(__file__).parent.parent / "playground"
ENVIRONMENT = "filtergym/ManeuveringTarget-v0"
FILTERS = {
    "imm": {"gain 0.3": ("bank_probabilities", 0, 1), "gain 0.7": ("bank_probabilities", 1, 1)},
    "kalman-imm-turn": {
        "quiet": ("probabilities", 0, 1),
        "noisy": ("probabilities", 1, 1),
        "turn": ("probabilities", 2, 1),
    },
    "semi-markov": {
        "straight": ("track_0_probability", 0, 12),
        "thrust": ("track_1_probability", 0, 4),
        "turn": ("track_2_probability", 0, 16),
    },
    "bptt-small": {"gain": ("bank_alpha", 0, 1)},
}
"""Filter -> weights of its hypotheses: the member of its state, its first number, and how many are summed. ``bptt-
small`` has no hypotheses, and shows the gain that its network sets.
"""

EXPORTED = """\
#include <stddef.h>

#include "{stem}.h"

static {stem}_state state;
static {stem}_initial initial;
static {stem}_measurement measurement;
static {stem}_estimate estimate;
static double weights[{count}];

static double sum(const double *first, int count) {{
    double total = 0.0;
    for (int i = 0; i < count; ++i) total += first[i];
    return total;
}}

#define EXPORT(name) __attribute__((export_name(name)))
EXPORT("initial") double *initial_place(void) {{ return (double *)&initial; }}
EXPORT("measurement") double *measurement_place(void) {{ return (double *)&measurement; }}
EXPORT("estimate") double *estimate_place(void) {{ return (double *)&estimate; }}
EXPORT("weights") double *weights_place(void) {{ return weights; }}
EXPORT("start") void start(void) {{ {stem}_start(&state, &initial, NULL); }}
EXPORT("update") int update(void) {{
    int became = {stem}_update(&state, &measurement, &estimate);
{sums}
    return became;
}}
"""
"""C functions that a page calls for one track; it writes and reads the structs as rows of doubles."""
FLAGS = (
    *("-target", "wasm32-wasi", "-mexec-model=reactor", "-std=c99", "-Oz", "-s"),
    *("-Wl,--no-entry", "-Wl,-z,stack-size=65536"),
)


def has_compiler() -> bool:
    """Return whether zig's C compiler is installed."""
    return importlib.util.find_spec("ziglang") is not None


def compile_filter(name: str) -> bytes:
    """Export a filter as C, compile it to WebAssembly, and return the module's bytes."""
    stem = file_stem(name)
    sums = [
        f"    weights[{i}] = sum((const double *)&state.{member} + {first}, {count});"
        for i, (member, first, count) in enumerate(FILTERS[name].values())
    ]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        export_c(request_export(problem_of(ENVIRONMENT), name), folder)
        source = EXPORTED.format(stem=stem, count=len(sums), sums="\n".join(sums))
        (folder / "page.c").write_text(source, encoding="ascii")
        words = ["cc", *FLAGS, "page.c", f"{stem}.c", "-lm", "-o", "page.wasm"]
        subprocess.run([sys.executable, "-m", "ziglang", *words], cwd=folder, check=True)
        return (folder / "page.wasm").read_bytes()


def page_script(modules: dict[str, bytes]) -> str:
    """Return JavaScript text with the playground's filters: names, weights, WebAssembly modules in base64."""
    filters = {
        name: {"weights": list(FILTERS[name]), "module": base64.b64encode(module).decode("ascii")}
        for name, module in modules.items()
    }
    return f"const PLAYGROUND_FILTERS = {json.dumps(filters)};\n"


def module_file(name: str) -> Path:
    """Return the path of a filter's committed WebAssembly module."""
    return FOLDER / f"{name}.wasm"


def read_modules() -> dict[str, bytes]:
    """Return each filter's WebAssembly module by name, compiled anew or, without a compiler, the committed one."""
    if has_compiler():
        return {name: compile_filter(name) for name in FILTERS}
    return {name: module_file(name).read_bytes() for name in FILTERS}
