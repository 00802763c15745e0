"""Where Python keeps the frames of calls: the compiler's calls go up and down across no end of a chunk."""

import resource

import pytest

from factorbus.solver.kernels.jit.frame_room import call_with_room

TURNS = 400


def test_no_call_below_has_memory_mapped_for_its_frame():
    """At some depths each of these calls maps memory by itself: more page faults than turns, in one depth of fifty."""
    assert call_with_room(_most_faults) < TURNS / 4


def test_it_gives_back_what_the_function_gives_and_raises_what_it_raises():
    assert call_with_room(divmod, 17, 5) == (3, 2)
    with pytest.raises(ZeroDivisionError):
        call_with_room(divmod, 17, 0)


def _most_faults() -> int:
    return max(_at(depth) for depth in range(1, 300))


def _at(depth: int) -> int:
    if depth:
        return _at(depth - 1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(TURNS):
        _four(4)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def _four(more: int) -> None:
    if more:
        _four(more - 1)
