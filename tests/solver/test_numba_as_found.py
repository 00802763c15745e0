"""Numba is as it was found: kernels of a user beside ours are compiled as in a process without us."""

import os
import subprocess
import sys
from itertools import zip_longest

import pytest

from factorbus.solver.kernels.jit import compile as _jit

pytestmark = pytest.mark.skipif(_jit.DISABLED, reason="nothing is compiled")

# Kernels in which all that we change would show: indices that count from the end, references, temporary arrays.
# Numba numbers functions as they come; but for that number the code is to be the same.
USER = """
import re
import numba
import numpy as np
from numba.core import types
from numba.core.runtime.context import NRTContext
from numba.np import arrayobj

def inside():
    return arrayobj.fix_integer_index, NRTContext._call_incref_decref, types.BaseFunction.get_call_type

found = inside()

def compiled():
    @numba.njit
    def pick(a, k):
        return a[k] + a[-1]

    @numba.njit
    def rows(a, n):
        total = np.zeros(a.shape[1])
        for k in range(n):
            total += a[k]
        return total, a[n - 1]

    @numba.njit(error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"}, nogil=True)
    def like_ours(a, k):
        b = a[k:].copy()
        return b[-1] + pick(a, k)

    a = np.arange(6.0)
    assert pick(a, -2) == 9.0 and like_ours(a, -1) == 15.0
    assert [part.tolist() for part in rows(a.reshape(2, 3), 2)] == [[3.0, 5.0, 7.0], [3.0, 4.0, 5.0]]
    text = "".join(ir for one in (pick, rows, like_ours) for ir in one.inspect_llvm().values())
    # Before 0.67 Numba names what it keeps by where that is, which is elsewhere in every process.
    text = re.sub(r"(pickle(?:data|buf)\\.|at 0x)[0-9a-f]+", r"\\1", text)
    # Functions are numbered as they are made, and so the names that have the number are of another length.
    return re.sub(r"\\[\\d+ x i8\\] c.missing", "missing", re.sub(r"B(\\d+)v\\d+", "B", text))

def show(*moments):
    assert inside() == found
    print("\\0".join(moments))
"""
ALONE = USER + "show(compiled(), compiled(), compiled())"
BESIDE = (
    USER
    + """
before = compiled()
import factorbus.solver
from factorbus.solver.kernels.jit import compile as _jit
from factorbus.solver.kernels.graph.observability import mark_determined
from factorbus.solver.kernels.bayes_tree.remove_rows import open_gaps
list(_jit.iter_compile(open_gaps))
assert inside() == found
between = compiled()
list(_jit.iter_compile(mark_determined))
assert _jit.compile_seconds() > 0
show(before, between, compiled())
"""
)


def ir(script: str, cache: object) -> list[str]:
    ran = subprocess.run(
        [sys.executable, "-c", script],
        # Flags that are a set are part of the name of a function, in the order of their hashes.
        env=os.environ | {"FACTORBUS_CACHE": str(cache), "PYTHONHASHSEED": "0"},
        capture_output=True, text=True, timeout=250, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.split("\0")


def test_kernels_of_a_user_are_compiled_as_without_us(tmp_path):
    alone, beside = ir(ALONE, tmp_path), ir(BESIDE, tmp_path)
    assert len(alone) == 3
    assert "NRT_incref" in alone[0]
    for moment, wanted, seen in zip(("before", "between", "after"), alone, beside, strict=True):
        differing = [pair for pair in zip_longest(wanted.splitlines(), seen.splitlines()) if pair[0] != pair[1]]
        assert not differing[:3], f"{len(differing)} lines of what was compiled {moment} ours"
