"""An edit compiles the kernels anew that have it in them, and no other."""

import os
import sys
import types
from pathlib import Path

import pytest
from tests.solver.test_jit import kernels, run

from factorbus.solver.kernels.jit import compile as _jit
from factorbus.solver.kernels.jit import disk
from factorbus.solver.kernels.jit.stamps import _of_value, stamp_of

__all__ = ["kernels"]

pytestmark = pytest.mark.skipif(_jit.DISABLED, reason="without the compiler nothing is on disk")

SOURCE = """
from typing import NamedTuple

import numpy as np

from factorbus import made_layout as at
from factorbus.solver.kernels.jit.compile import inline_kernel, kernel, part, shared_kernel, types
from factorbus.solver.kernels.jit.records import Floats, Ints, opener

SIZES = np.array([3, 6])
LIMIT = 2.0

class Lists(NamedTuple):
    starts: Ints
    values: Floats

lists_at = opener(Lists)

@inline_kernel
def twice(x):
    return 2.0 * x

@part
def capped(x):
    return min(twice(x), LIMIT)

@shared_kernel(types.float64(types.float64))
def far(x):
    return x + 1.0

@kernel("float64(float64)")
def calls(x):
    "What it does."
    return capped(x)

@kernel("int64(int64)")
def looks_up(k):
    return SIZES[k]

@kernel("int64(int64)")
def names_a_column(k):
    return k + at.F_KIND

@kernel("float64(int64[::1])")
def opens(table):
    return lists_at(table).values[0]

@kernel("float64(float64)")
def goes_far(x):
    return far(x)
"""
NAMES = ("calls", "looks_up", "names_a_column", "opens", "goes_far", "far")


def stamps(source: str, monkeypatch: pytest.MonkeyPatch, kind: int = 1) -> dict[str, str]:
    layout = types.ModuleType("factorbus.made_layout")
    layout.__dict__.update(F_KIND=kind, F_OTHER=2 * kind)
    monkeypatch.setitem(sys.modules, layout.__name__, layout)
    monkeypatch.setattr("factorbus.made_layout", layout, raising=False)
    made = types.ModuleType("factorbus.made")
    monkeypatch.setitem(sys.modules, made.__name__, made)
    # What is made here is not provided to the kernels that other tests compile in this process.
    monkeypatch.setattr(_jit._FOLDER, "_shared", [])
    exec(compile(source, __file__, "exec"), made.__dict__)
    return {name: stamp_of(getattr(made, name)) for name in NAMES}


@pytest.mark.parametrize(
    ("old", "new", "anew"),
    [
        ("SIZES = ", "# A comment and more lines.\n\n\nSIZES = ", set()),
        ("What it does.", "What it is for.", set()),
        ("2.0 * x", "3.0 * x", {"calls"}),
        ("twice(x), LIMIT", "LIMIT, twice(x)", {"calls"}),
        ("LIMIT = 2.0", "LIMIT = 4.0", {"calls"}),
        ("@inline_kernel", "@part", {"calls"}),
        ("[3, 6]", "[3, 7]", {"looks_up"}),
        ("at.F_KIND", "at.F_OTHER", {"names_a_column"}),
        ("    starts: Ints\n    values: Floats", "    values: Floats\n    starts: Ints", {"opens"}),
        ("    starts: Ints\n", "    starts: Floats\n", {"opens"}),
        ("x + 1.0", "x + 2.0", {"far"}),
        ("(types.float64))\ndef far", "(types.int64))\ndef far", {"far", "goes_far"}),
        ('"int64(int64)")\ndef looks_up', '"int64(int32)")\ndef looks_up', {"looks_up"}),
    ],
)
def test_an_edit_is_seen_by_the_kernels_that_have_it(
    old: str, new: str, anew: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if _jit.STOCK and "far" in anew:
        # Nothing is called by its address, and nothing that is declared of it matters to its callers.
        anew = {"far"} if "types." in old else {"far", "goes_far"}
    before = stamps(SOURCE, monkeypatch)
    assert SOURCE.count(old) == 1
    after = stamps(SOURCE.replace(old, new), monkeypatch)
    assert {name for name in NAMES if before[name] != after[name]} == anew


def test_a_constant_of_another_module_counts_where_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    before, after = stamps(SOURCE, monkeypatch), stamps(SOURCE, monkeypatch, kind=5)
    assert {name for name in NAMES if before[name] != after[name]} == {"names_a_column"}


def test_a_thing_that_may_change_unseen_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    odd = SOURCE.replace("LIMIT = 2.0", "LIMIT = iter(())")
    with pytest.raises(TypeError, match=r"factorbus\.made\.capped: LIMIT is a builtins\.tuple_iterator"):
        stamps(odd, monkeypatch)


SHARED = """
from kernels.jit import compile as _jit

@_jit.shared_kernel(_jit.types.float64(_jit.types.float64))
def far(x):
    return x + {more}

@_jit.kernel("float64(float64)")
def goes_far(x):
    return far(x)
"""
CALL_SHARED = """
import os
from kernels import shared
from kernels.jit import compile as _jit
was_there = _jit.is_on_disk(shared.goes_far), _jit.is_on_disk(shared.far)
print(shared.goes_far(1.0), *was_there)
"""


@pytest.mark.skipif(_jit.STOCK, reason="with Numba as it is a caller has the code of what it calls")
def test_a_caller_stays_as_it_is_and_calls_what_was_edited(kernels: Path) -> None:
    for more, told in ((1.0, "2.0 False False"), (1.0, "2.0 True True"), (30.0, "31.0 True False")):
        (kernels / "shared.py").write_text(SHARED.format(more=more))
        assert run(kernels, CALL_SHARED).stdout.strip() == told


COMPILE_ALONE = """
from kernels import shared
from kernels.jit import compile as _jit
_jit.only_compile()
list(_jit.iter_compile(shared.goes_far))
print(_jit.is_on_disk(shared.goes_far), _jit.is_on_disk(shared.far))
"""


@pytest.mark.skipif(_jit.STOCK, reason="with Numba as it is a caller has the code of what it calls")
def test_who_compiles_for_others_does_not_compile_what_is_called_by_its_address(kernels: Path) -> None:
    (kernels / "shared.py").write_text(SHARED.format(more=1.0))
    assert run(kernels, COMPILE_ALONE).stdout.strip() == "True False"
    assert run(kernels, CALL_SHARED).stdout.strip() == "2.0 True False"


def test_the_versions_of_a_kernel_that_were_used_last_stay(tmp_path: Path) -> None:
    cache = disk.cache_in(lambda: tmp_path)
    files = [cache(twice, lambda n=n: f"stamp{n}")._cache_file for n in range(8)]
    for n, file in enumerate(files[:6]):
        file.save("signature", f"code {n}")
        for path in tmp_path.glob(f"*stamp{n}*"):
            os.utime(path, (1e9 + n, 1e9 + n))
    other = cache(thrice, lambda: "stamp0")._cache_file
    other.save("signature", "other code")
    assert files[0].load("signature") == "code 0"
    files[6].save("signature", "code 6")
    files[7].save("signature", "code 7")
    assert [file.load("signature") for file in files] == [
        *("code 0", None, None),
        *(f"code {n}" for n in range(3, 8)),
    ]
    assert len(list(tmp_path.iterdir())) == 2 * 7
    assert other.load("signature") == "other code"


def twice(x: float) -> float:
    return 2.0 * x


def thrice(x: float) -> float:
    return 3.0 * x


def test_slices_count_by_their_ends() -> None:
    """From Python 3.14 on `x[1:3]` has one among the constants of its bytecode."""
    spans = (slice(1, 3), slice(1, 4), slice(0, 3), slice(1, 3, 2), slice(None, 3), (1, 3, None))
    known = [_of_value("span", span, set(), []) for span in spans]
    assert len(set(known)) == len(spans)
    assert _of_value("span", slice(1, 3), set(), []) == known[0]
