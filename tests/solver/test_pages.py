"""Arrays that grow in place keep what they hold, also for views of them."""

import mmap
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from factorbus.solver.graph import pages
from factorbus.solver.kernels.jit.compile import F64


@dataclass
class Owner:
    numbers: F64 = field(default_factory=lambda: pages.zeros(1000))


def test_what_grows_keeps_its_numbers_and_the_rest_is_zero() -> None:
    owner = Owner()
    owner.numbers[:] = np.arange(1000)
    for size in (1001, 5000, 3_000_000):
        pages.enlarge(owner, "numbers", size)
        assert owner.numbers.size == size
        assert owner.numbers.flags.carray
        assert owner.numbers.ctypes.data % 64 == 0
        assert np.array_equal(owner.numbers[:1000], np.arange(1000))
        assert not owner.numbers[1000:].any()


def test_nothing_is_copied_where_pages_can_be_moved() -> None:
    owner = Owner()
    base = owner.numbers.base.obj  # type: ignore[union-attr]
    pages.enlarge(owner, "numbers", 100_000)
    assert owner.numbers.base.obj is base  # type: ignore[union-attr]


@pytest.mark.skipif(not Path("/sys/kernel/mm/transparent_hugepage").is_dir(), reason="a system without huge pages")
def test_arrays_have_small_pages_until_they_are_large() -> None:
    if not tells_advice():
        pytest.skip("the flags of memory in /proc are not those that were asked for, as where a processor is emulated")
    owner = Owner()
    for size, flag in ((300_000, "nh"), (30_000_000, "nh"), (70_000_000, "hg")):  # nothing is written to them
        pages.enlarge(owner, "numbers", size)
        assert flag in flags_of(owner.numbers.ctypes.data)
    assert len(owner.numbers.base.obj) % (2 << 20) == 0  # type: ignore[union-attr]


def tells_advice() -> bool:
    """Whether /proc has the flag of memory that is to have small pages."""
    with mmap.mmap(-1, 4 << 20) as memory:
        memory.madvise(mmap.MADV_NOHUGEPAGE)
        return "nh" in flags_of(np.frombuffer(memory, np.uint8).ctypes.data)


def flags_of(address: int) -> list[str]:
    """The kernel's flags of the memory that `address` is in."""
    inside = False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        first, *rest = line.split()
        if not first.endswith(":"):
            start, end = (int(one, 16) for one in first.split("-"))
            inside = start <= address < end
        elif inside and first == "VmFlags:":
            return rest
    return []


def test_a_view_that_somebody_has_stays_as_it_is() -> None:
    owner = Owner()
    owner.numbers[:] = 7.0
    view = owner.numbers[10:20]
    pages.enlarge(owner, "numbers", 4000)
    owner.numbers[:] = 8.0
    assert (view == 7.0).all()


def test_an_array_from_elsewhere_is_copied() -> None:
    owner = Owner(np.ones(50))
    pages.enlarge(owner, "numbers", 60)
    assert owner.numbers.sum() == 50.0
    assert owner.numbers.size == 60


def test_without_memory_nothing_has_changed() -> None:
    owner = Owner()
    owner.numbers[:] = 3.0
    with pytest.raises(MemoryError, match="doubles"):
        pages.enlarge(owner, "numbers", 1 << 50)
    assert owner.numbers.size == 1000
    assert (owner.numbers == 3.0).all()
