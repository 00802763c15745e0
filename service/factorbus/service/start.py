"""What a service does once before it takes anything: compile or load kernels, and settle heaps and interpreter."""

import gc
import logging
import sys

from factorbus.service.heap import lay_out_heaps

log = logging.getLogger(__name__)


def get_ready_to_compute(warm: bool) -> None:
    """Have every kernel at hand, if `warm`; afterwards the interpreter pauses as rarely and as shortly as can be."""
    lay_out_heaps()
    if warm:
        from factorbus.service.warm import warm as warm_all

        seconds = warm_all(lambda name: log.info("compiling kernels: %s", name))
        log.info("kernels ready after %.1f s", seconds)
    # The compiler leaves some hundred thousand objects that live on: not walking them again saves pauses of 0.1 s.
    gc.collect()
    gc.freeze()
    # Inserts leave no cycles; looking for them after every 700 objects put 1 ms on top of every 50th exchange.
    gc.set_threshold(20_000, 50, 100)
    # Callbacks and the solver's Python share one interpreter lock; the default of 5 ms is longer than most steps.
    sys.setswitchinterval(0.0005)
