"""Where compiled kernels are kept, and that a stale one never runs."""

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from factorbus.solver.kernels.jit import compile as _jit
from factorbus.solver.kernels.jit import disk as _disk
from factorbus.solver.kernels.jit import frame_room as _room
from factorbus.solver.kernels.jit import held as _held
from factorbus.solver.kernels.jit import lowering as _lowering
from factorbus.solver.kernels.jit import releases as _releases
from factorbus.solver.kernels.jit import shared as _shared
from factorbus.solver.kernels.jit import stamps as _stamps

MAKERS = [Path(one.__file__) for one in (_disk, _held, _jit, _lowering, _releases, _room, _shared, _stamps)]
CALLER = """
from kernels.jit import compile as _jit
from kernels.callee import twice

@_jit.kernel("float64(float64[::1])")
def four_times(a):
    return twice(twice(a[{index}]))
"""
CALLEE = """
from kernels.jit import compile as _jit

@_jit.inline_kernel
def twice(x):
    return {factor} * x
"""
SCRIPT = """
import numpy as np
from kernels import caller
from kernels.jit import compile as _jit
print(caller.four_times(np.ones(3)), _jit.compile_seconds() > 0.0, _jit.cache_folder().name)
"""


@pytest.fixture
def kernels(tmp_path: Path) -> Path:
    """A package with the real decorators and two small kernels."""
    folder = tmp_path / "kernels"
    (folder / "jit").mkdir(parents=True)
    for file in MAKERS:
        shutil.copy(file, folder / "jit")
    write(folder)
    return folder


def write(folder: Path, factor: float = 2.0, index: int = 0) -> None:
    (folder / "caller.py").write_text(CALLER.format(index=index))
    (folder / "callee.py").write_text(CALLEE.format(factor=factor))


def run(folder: Path, script: str = SCRIPT, **environment: str) -> subprocess.CompletedProcess:
    """In a process that leaves no bytecode: Python tells it by size and second, and an edit here is soon and small."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    return subprocess.run(
        [sys.executable, "-B", "-c", script],
        env={**clean, "PYTHONPATH": str(folder.parent), "FACTORBUS_CACHE": str(folder.parent / "cache"), **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )


def results(folder: Path, **environment: str) -> tuple[float, bool, str]:
    done = run(folder, **environment)
    assert done.returncode == 0, done.stderr
    value, compiled, name = done.stdout.split()
    return float(value), compiled == "True", name


def test_kernels_come_from_disk_until_a_callee_in_another_file_is_edited(kernels):
    value, compiled, folder = results(kernels)
    assert (value, compiled) == (4.0, True)
    assert results(kernels) == (4.0, False, folder)
    write(kernels, factor=3.0)
    assert results(kernels) == (9.0, True, folder)
    write(kernels, factor=2.0)
    assert results(kernels) == (4.0, False, folder)


def test_bounds_checked_kernels_are_others(kernels):
    write(kernels, index=3)
    assert run(kernels).returncode == 0
    checked = run(kernels, NUMBA_BOUNDSCHECK="1")
    assert checked.returncode != 0
    assert "IndexError" in checked.stderr


PARTS = """
from kernels.jit import compile as _jit

@_jit.part
def entry(a, k):
    return a[k]

@_jit.part
def entries(a, k):
    return entry(a, k) + entry(a, k + 1)

@_jit.kernel("float64(float64[::1], int64)")
def pair(a, k):
    return entries(a, k)

@_jit.kernel("float64(float64[::1])")
def pairs(a):
    return pair(a, 0) + entry(a, 2) + pair(a, {last})
"""
CALL_PARTS = """
import numpy as np
from kernels import parts
from kernels.jit import compile as _jit
a = np.arange(4.0)
print(parts.pairs(a), parts.pair(a, 1), parts.entries(a, 1), _jit.is_on_disk(parts.pairs))
"""
LIST_SYMBOLS = """
from kernels import parts
from kernels.jit import compile as _jit
list(_jit.iter_compile(parts.pairs))
(result,) = parts.pairs.overloads.values()
print(*sorted(one.name for one in result.library.get_defined_functions() if one.linkage.name != "internal"))
print(*sorted([result.fndesc.llvm_func_name, result.fndesc.llvm_cpython_wrapper_name]))
"""


def test_parts_and_kernels_are_called_by_kernels_and_from_python_compiled_and_from_disk(kernels):
    (kernels / "parts.py").write_text(PARTS.format(last=2))
    for _ in range(2):
        done = run(kernels, CALL_PARTS)
        assert (done.stdout, done.stderr) == ("8.0 3.0 3.0 True\n", "")


def test_an_index_out_of_bounds_in_a_part_of_a_part_is_told(kernels):
    (kernels / "parts.py").write_text(PARTS.format(last=3))
    for _ in range(2):
        checked = run(kernels, CALL_PARTS, NUMBA_BOUNDSCHECK="1")
        assert checked.returncode != 0
        assert "IndexError" in checked.stderr


INDICES = """
import numba
from kernels.jit import compile as _jit

@_jit.inline_kernel
def last(a):
    return a[-1] + a[1:-1].sum()

@_jit.kernel("float64(float64[::1], int64)")
def entry(a, k):
    return a[k] if k < a.size else last(a)

@numba.njit
def foreign(a, k):
    return a[k]
"""
TAKE_INDICES = """
import numpy as np
from kernels import indices
a = np.arange(8.0)
print(indices.entry(a[1:], 2), indices.entry(a, 8), indices.foreign(a[1:], -1), indices.foreign(a, -2))
print(indices.entry(a[1:], -1))
"""


@pytest.mark.skipif(_jit.STOCK, reason="Numba as it is looks for all indices that count from the end")
def test_only_a_constant_counts_from_the_end_and_only_in_our_kernels(kernels):
    (kernels / "indices.py").write_text(INDICES)
    done = run(kernels, TAKE_INDICES)
    assert (done.stdout, done.stderr) == ("3.0 28.0 7.0 6.0\n0.0\n", "")
    checked = run(kernels, TAKE_INDICES, NUMBA_BOUNDSCHECK="1")
    assert checked.stdout == "3.0 28.0 7.0 6.0\n"
    assert "IndexError" in checked.stderr


@pytest.mark.skipif(_jit.STOCK, reason="Numba as it is shows all functions of a library")
def test_a_kernel_shows_others_nothing_of_its_parts(kernels):
    (kernels / "parts.py").write_text(PARTS.format(last=2))
    done = run(kernels, LIST_SYMBOLS)
    shown, own = done.stdout.splitlines()
    assert shown == own


FOR_OTHERS = """
import numpy as np
from numba.core.lowering import BaseLower
from kernels.jit import compile as _jit

write, written = BaseLower.create_cfunc_wrapper, []

def counted(lower):
    written.append(lower.fndesc.qualname)
    write(lower)

BaseLower.create_cfunc_wrapper = counted

@_jit.kernel("int64(int64)")
def sum_of_new(n):
    return np.zeros(n, np.int64).sum()
{first}
list(_jit.iter_compile(sum_of_new))
print(any("zeros" in name for name in written), any("sum_of_new" in name for name in written))
"""


@pytest.mark.skipif(_jit.STOCK, reason="Numba as it is writes each function as C would call it")
def test_what_numba_adds_is_not_written_for_c_where_nothing_is_run(kernels):
    for name, first, wanted in (("runs", "", "True False\n"), ("compiles", "_jit.only_compile()", "False False\n")):
        (kernels / f"{name}.py").write_text(FOR_OTHERS.format(first=first))
        done = run(kernels, f"import kernels.{name}")
        assert (done.stdout, done.stderr) == (wanted, "")


INLINE_FIRST = """
from kernels.jit import compile as _jit

@_jit.part
def entry(a, k):
    return a[k]

@_jit.inline_kernel
def first(a):
    return entry(a, 0)

@_jit.kernel("float64(float64[::1])")
def kernel(a):
    return first(a)

list(_jit.iter_compile(kernel))
for one in (entry, first):
    (result,) = one.overloads.values()
    print("alwaysinline" in result.library.get_llvm_str())
"""


def test_a_part_is_no_inline_kernel_because_one_had_it_compiled(kernels):
    (kernels / "parts.py").write_text(INLINE_FIRST)
    done = run(kernels, "import kernels.parts")
    assert (done.stdout, done.stderr) == ("False\nTrue\n", "")


def test_a_variable_that_does_not_change_the_code_leaves_the_folder(kernels):
    _, _, name = results(kernels)
    assert results(kernels, NUMBA_NUM_THREADS="1") == (4.0, False, name)
    assert results(kernels, NUMBA_OPT="1")[2] != name


def test_without_compilation_nothing_is_compiled(kernels):
    value, compiled, _ = results(kernels, NUMBA_DISABLE_JIT="1")
    assert (value, compiled) == (4.0, False)


def test_a_folder_that_cannot_be_written_is_said_and_replaced(kernels, tmp_path):
    (tmp_path / "file").write_text("in the way")
    done = run(kernels, FACTORBUS_CACHE=str(tmp_path / "file"))
    assert done.returncode == 0
    assert done.stdout.split()[:2] == ["4.0", "True"]
    assert "set FACTORBUS_CACHE to one that is" in done.stderr
    assert run(kernels, FACTORBUS_CACHE=str(tmp_path / "file")).stdout.split()[1] == "True"


def test_a_kernel_that_somebody_else_may_have_written_is_not_run(kernels, tmp_path):
    assert results(kernels)[1]
    files = [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".nbi", ".nbc"}
    assert not any(path.stat().st_mode & 0o077 for path in [tmp_path / "cache", *(tmp_path / "cache").rglob("*")])
    for suffix in (".nbi", ".nbc"):
        (file,) = [path for path in files if path.suffix == suffix and "four_times" in path.name]
        file.chmod(0o666)
        done = run(kernels)
        assert done.returncode == 1
        assert f"UnsafeFolder: the compiled kernel {file} is not used: everybody can write to it" in done.stderr
        file.chmod(0o600)
    assert results(kernels)[:2] == (4.0, False)


def test_old_folders_go_and_the_newest_stay(kernels, tmp_path):
    base = tmp_path / "cache" / "kernels"
    for age in range(10):
        (base / f"old{age}").mkdir(parents=True)
        os.utime(base / f"old{age}", (1e9 - age, 1e9 - age))
    _, _, name = results(kernels)
    assert {path.name for path in base.iterdir()} == {name, *(f"old{age}" for age in range(5))}


def test_a_version_that_another_process_has_removed_is_not_missed(kernels, tmp_path):
    """It was listed, and is gone before it is asked how old it is."""
    results(kernels)
    (file,) = (tmp_path / "cache").rglob("*four_times*.nbi")
    gone = file.with_name(f"{file.stem.rpartition('-')[0]}-gone.nbi")
    gone.symlink_to(tmp_path / "nowhere")
    file.unlink()
    assert results(kernels)[:2] == (4.0, True)
    assert results(kernels)[:2] == (4.0, False)


def test_the_folder_is_another_where_kernels_are_compiled_otherwise(kernels):
    _, _, first = results(kernels)
    with (kernels / "jit" / "disk.py").open("a") as file:
        file.write("# edited\n")
    value, compiled, second = results(kernels)
    assert (value, compiled) == (4.0, True)
    (kernels / "jit" / "more.py").write_text("")
    assert len({first, second, results(kernels)[2]}) == 3


def test_kernels_of_another_folder_have_a_cache_of_their_own_and_exact_ones_round_as_written(tmp_path):
    folder = tmp_path / "others"
    folder.mkdir()
    script = (
        "import numpy as np\n"
        "from factorbus.solver.kernels.jit import compile as _jit\n"
        "import others.sums\n"
        "a = np.array([3.0, 1e17, -1e17, 1.0])\n"
        "print(others.sums.total(a), _jit.compile_seconds() > 0.0, others.sums.FOLDER.path().name)\n"
    )
    text = (
        "from factorbus.solver.kernels.jit import compile as _jit\n"
        "FOLDER = _jit.KernelFolder('sums', exact=True)\n"
        "@FOLDER.kernel('float64(float64[::1])')\n"
        "def total(a):\n"
        "    s = 0.0\n"
        "    for k in range(a.size):\n"
        "        s += {} * a[k]\n"
        "    return s\n"
    )
    clean = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    seen = []
    for factor in (1.0, 1.0, 10.0):
        (folder / "sums.py").write_text(text.format(factor))
        environment = {**clean, "PYTHONPATH": str(tmp_path), "FACTORBUS_CACHE": str(tmp_path / "cache")}
        done = subprocess.run(
            [sys.executable, "-B", "-c", script], env=environment, capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
        seen.append(done.stdout.split())
    # In the order written 3 is lost in 1e17 and 1 is not; any other order gives another sum.
    assert [(value, compiled) for value, compiled, _ in seen] == [("1.0", "True"), ("1.0", "False"), ("10.0", "True")]
    (name,) = {name for *_, name in seen}
    assert len(list((tmp_path / "cache" / "sums" / name).glob("*.nbi"))) == 2


@_jit.kernel("float64(float64[::1])")
def first_of(a):
    return a[0]


@_jit.kernel
def any_first(a):
    return a[0]


@pytest.mark.skipif(_jit.DISABLED, reason="without compilation there are no types to refuse")
def test_a_kernel_with_a_signature_takes_nothing_else():
    assert first_of(np.ones(3)) == 1.0
    for wrong in (np.ones((2, 2)), np.ones(6)[::2], np.ones(3, np.float32), np.ones(3, np.int64)):
        with pytest.raises(TypeError, match="No matching definition"):
            first_of(wrong)
    assert any_first(np.ones(6)[::2]) == 1.0


def test_first_calls_from_many_threads():
    start, answers = threading.Barrier(4), []

    @_jit.kernel("float64(float64[::1])")
    def last_of(a):
        return a[a.size - 1]

    def call() -> None:
        start.wait(30)
        answers.append(last_of(np.arange(3.0)))

    threads = [threading.Thread(target=call) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert answers == [2.0] * 4


def test_compiling_ahead_names_each_kernel():
    assert list(_jit.iter_compile(first_of)) == ["first_of"]
    assert first_of(np.ones(1)) == 1.0
