"""A service has as many threads that lend their cores as it was told to, of the cores that there are."""

import threading

import pytest

from factorbus.service import cores
from factorbus.service.cores import LentCores
from factorbus.solver.lending import count_free

pytestmark = pytest.mark.skipif(
    count_free() == 0, reason="threads cannot sleep in kernels here, so no core can be lent"
)


def lending() -> int:
    return sum(thread.name.startswith("core ") for thread in threading.enumerate())


@pytest.mark.parametrize(("told", "there", "used"), [(2, 4, 2), (4, 2, 2), (2, 1, 1), (1, 4, 1), (99, 99, 8)])
def test_no_more_than_told_and_than_there_are(
    monkeypatch: pytest.MonkeyPatch, told: int, there: int, used: int
) -> None:
    monkeypatch.setattr(cores, "core_count", lambda: there)
    free, lent = count_free(), LentCores(told)
    assert lent.account() == {"used": used, "pieces": 0}
    assert lending() == used - 1
    assert count_free() == free - (used - 1)
    lent.close()
    assert lending() == 0
    assert count_free() == free
