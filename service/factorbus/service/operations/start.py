"""What a service does once before it takes anything: compile or load kernels, and settle heaps and interpreter."""

import gc
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from factorbus.service.process.heap import lay_out_heaps
from factorbus.solver import why_stock_numba

log = logging.getLogger(__name__)


@contextmanager
def ready_to_compute(warm: bool) -> Iterator[None]:
    """Have every kernel at hand, if `warm`; while inside, the interpreter pauses as rarely and as shortly as can be.

    Afterwards collector and interpreter are set as they were: the process is not the service's own.  Only heaps stay
    as laid out here; glibc does not say how they were.
    """
    lay_out_heaps()
    if why := why_stock_numba():
        log.warning("kernels are compiled by Numba as it is, which takes longer, and take longer themselves: %s", why)
    if warm:
        from factorbus.service.operations.warm import warm_service as warm_all

        seconds = warm_all(lambda name: log.info("compiling kernels: %s", name))
        log.info("kernels ready after %.1f s", seconds)
    thresholds, frozen, interval_s = gc.get_threshold(), gc.get_freeze_count(), sys.getswitchinterval()
    # The compiler leaves some hundred thousand objects that live on: not walking them again saves pauses of 0.1 s.
    gc.collect()
    gc.freeze()
    # Inserts leave no cycles; looking for them after every 700 objects put 1 ms on top of every 50th exchange.
    gc.set_threshold(20_000, 50, 100)
    # Callbacks and the solver's Python share one interpreter lock; the default of 5 ms is longer than most steps.
    sys.setswitchinterval(0.0005)
    try:
        yield
    finally:
        sys.setswitchinterval(interval_s)
        gc.set_threshold(*thresholds)
        if not frozen:
            gc.unfreeze()
