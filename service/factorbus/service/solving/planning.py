"""The insert by which a map takes out poses that it has enough of: made from what it has, and applied as any other."""

import logging

import numpy as np

from factorbus.proto import codec
from factorbus.proto.arrays import I64
from factorbus.proto.keep import KeepSettings
from factorbus.proto.messages import Batch, Change, Factors, Insert
from factorbus.proto.own_clients import KEEPER
from factorbus.service.core.events import Arrived
from factorbus.service.core.removals import Planned
from factorbus.service.solving.arrival import read_again
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.lifelong.plan import plan_removals
from factorbus.solver.lifelong.policy import KeepPolicy

MOST = 64  # poses of one insert: an insert of a client may have to wait for it

log = logging.getLogger(__name__)


def plan_insert(
    graph: FactorGraph, keep: KeepSettings, staying: I64, number: int
) -> tuple[Planned, tuple[Arrived, ...]]:
    """What goes next, and the insert with that number; none, where nothing does.  staying: keys of poses that stay."""
    try:
        policy = KeepPolicy(keep.per_area_m, keep.poses, keep.window, keep.landmarks, keep.loss)
        plan = plan_removals(graph, policy, MOST, staying)
    except Exception:
        log.exception("what a map has enough of cannot be told; it keeps everything until the next insert")
        return Planned(0, failed=True), ()
    planned = Planned(plan.keys.size, plan.loss, plan.left)
    if not planned.poses:
        return planned, ()
    changes = Change("remove_factors", plan.factors), Change("remove_variables", keys=plan.keys, alone=True)
    added = tuple(Factors(each.kind, each.keys, each.measured, each.information) for each in plan.added)
    message = codec.encode_insert(Insert(number, Batch((), added), changes=changes))
    digest, content = read_again(message)
    return planned, (Arrived([], KEEPER, number, 0, len(message), digest, content, 0.0, message),)


NOTHING_STAYS = np.empty(0, np.int64)
