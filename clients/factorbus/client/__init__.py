"""The client library: insert into a map over the bus, follow its estimate, ask it questions.

    with connect("tcp/127.0.0.1:7447", client="robot1") as bus, bus.map("kitchen") as kitchen:
        kitchen.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
        print(kitchen.estimate["x0"])

`factorbus.client.aio` is the same for asyncio.  Light: numpy, msgpack and zenoh, no compiler.
"""

from factorbus.client.aligning import Alignment, AmbiguousAlignment, NotAligned, align
from factorbus.client.attaching import Attached, attach
from factorbus.client.bus import Bus, connect
from factorbus.client.changes import Changes
from factorbus.client.detaching import undo_attach
from factorbus.client.draft import Draft
from factorbus.client.features import Features, Growing
from factorbus.client.filter_state import Factored, FilterState
from factorbus.client.imu import ImuNoise, Standstill, cut_samples, initial_from_standstill
from factorbus.client.imu_samples import ImplausibleSamples
from factorbus.client.map import Map
from factorbus.client.map_row import MapRow
from factorbus.client.merging import AbsoluteFactors, CannotMerge, KeyCollision, Merged, NoAnchor
from factorbus.client.mirror import Mirror
from factorbus.client.pending_insert import NoAnswerYet, PendingInsert
from factorbus.client.preintegration import PreintegratedImu, preintegrate_samples
from factorbus.client.renaming_kinds import rename_kinds
from factorbus.client.smoothed_poses import BlendedPose
from factorbus.client.snapshot import Snapshot
from factorbus.proto.camera import BadCamera, Camera
from factorbus.proto.interest import Interest
from factorbus.proto.problems import NotConverged, Problem, Refused, Unavailable

__all__ = [
    "AbsoluteFactors",
    "Alignment",
    "AmbiguousAlignment",
    "Attached",
    "BadCamera",
    "BlendedPose",
    "Bus",
    "Camera",
    "CannotMerge",
    "Changes",
    "Draft",
    "Factored",
    "Features",
    "FilterState",
    "Growing",
    "ImplausibleSamples",
    "ImuNoise",
    "Interest",
    "KeyCollision",
    "Map",
    "MapRow",
    "Merged",
    "Mirror",
    "NoAnchor",
    "NoAnswerYet",
    "NotAligned",
    "NotConverged",
    "PendingInsert",
    "PreintegratedImu",
    "Problem",
    "Refused",
    "Snapshot",
    "Standstill",
    "Unavailable",
    "align",
    "attach",
    "connect",
    "cut_samples",
    "initial_from_standstill",
    "preintegrate_samples",
    "rename_kinds",
    "undo_attach",
]
