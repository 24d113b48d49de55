"""Parity, gradients and stored trajectories as other processors compute them: run by `make test-processors`.

Every setting takes instructions away from one of those that compute, or from all, and runs the tests that are marked
``processors``: their tolerances follow from conditioning (:mod:`rounding`), so what holds here must hold there.
"""

import os
import platform
import subprocess
import sys
from pathlib import Path

from numpy._core import _multiarray_umath as umath

BARE = {"FILTERGYM_COMPILER_PROCESSOR": "x86-64"}
NUMPY = {"NPY_DISABLE_CPU_FEATURES": " ".join(f for f in umath.__cpu_dispatch__ if umath.__cpu_features__[f])}
BLAS = {"OPENBLAS_CORETYPE": "Prescott"}
TORCH = {"ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "COMPATIBLE"}
LIBC = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX2,-AVX2_Usable,-FMA,-FMA4"}

SETTINGS = {
    "compiled for bare x86-64, functions of the C library one by one": BARE,
    "compiled for Haswell, four numbers a call": {"FILTERGYM_COMPILER_PROCESSOR": "haswell,+avx2,+fma"},
    "NumPy without what it chooses by processor": NUMPY,
    "torch without vector instructions, MKL as on any processor": TORCH,
    "all of them, OpenBLAS and the C library, too, as bare as they get": {
        **BARE,
        **NUMPY,
        **BLAS,
        **TORCH,
        **LIBC,
    },
}
"""Environment variables by what they do; of x86 only."""
CHOSEN = "not TightlyCoupledNavigation or ((evidence or rewards) and not gradients)"
"""Of the tests that are marked: code of TightlyCoupledNavigation takes long to compile, gradients longest, and one
control reports."""


def main() -> None:
    """Run the tests under each setting; exit with 1 if any of them fails."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        print(f"The settings are of x86 processors, and this one is {platform.machine()}: nothing is tried.")
        return
    # Only the files that hold such tests: to import all of them takes longer than to run these.
    files = [
        path for path in Path(__file__).parent.glob("test_*.py") if "mark.processors" in path.read_text()
    ]
    tests = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-m",
        "processors",
        "-k",
        CHOSEN,
        *sys.argv[1:],
        *sorted(files),
    ]
    failed = []
    for name, variables in SETTINGS.items():
        print(f"{name}: {' '.join(f'{key}={value!r}' for key, value in variables.items())}", flush=True)
        if subprocess.run(tests, check=False, env={**os.environ, **variables}).returncode:
            failed.append(name)
    sys.exit(f"failed: {'; '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
