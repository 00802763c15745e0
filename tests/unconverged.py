"""A map that has not converged with its inserts, and goes on by itself."""

import time

from turned import closing, drive

from factorbus.proto import codec
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Insert
from factorbus.service.core.events import Arrived
from factorbus.service.solving.arrival import read_insert

EPOCH, PATIENCE_S = 7, 120.0
POSES, DEGREES = 100, 120.0
# Few tries in each step, so that there are many steps.
FEW = {"max_iterations": 2, "max_nonmonotone_steps": 0}


def arrived(sequence: int, batch: Batch) -> Arrived:
    made = read_insert(None, "a", codec.encode_insert(Insert(sequence, batch)), REQUEST_LIMITS, time.monotonic())
    assert isinstance(made, Arrived)
    return made._replace(askers=[f"asker {sequence}"])


def inserts() -> list[Arrived]:
    return [arrived(n + 1, batch) for n, batch in enumerate((*drive(POSES, DEGREES), closing(POSES)))]
