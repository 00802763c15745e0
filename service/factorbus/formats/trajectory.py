"""The poses of a graph in the order of time, as trajectory files list them."""

import math

from factorbus.formats.errors import FormatError
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import format_symbol, symbol_parts


def stamped_poses(batch: Batch, form: str) -> list[tuple[int, list[float]]]:
    """(time stamp, x y z qx qy qz qw) of every pose of `batch`, in the order of the stamps.

    The time stamp is the index of the key (x12 → 12), or the place in the order of the keys when two share an index.
    2D poses lie in the plane z = 0.  Points are left out.  Raises FormatError, which speaks of `form`, for a pose
    without a value.
    """
    poses: dict[int, list[float]] = {}
    for group in batch.variables:
        if group.kind in ("se2", "se3"):
            if group.values is None:
                raise FormatError(
                    form, None, f"{format_symbol(int(group.keys[0]))} has no value", "a value for every pose"
                )
            lift = _lifted if group.kind == "se2" else list
            poses.update(zip(group.keys.tolist(), map(lift, group.values.tolist()), strict=True))
    keys = sorted(poses)
    stamps = [symbol_parts(key)[1] for key in keys]
    if len(set(stamps)) < len(stamps):
        stamps = list(range(len(keys)))
    return sorted(zip(stamps, (poses[key] for key in keys), strict=True), key=lambda row: row[0])


def _lifted(pose: list[float]) -> list[float]:
    """(x, y, theta) in the plane z = 0 of 3D."""
    x, y, theta = pose
    return [x, y, 0.0, 0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2)]
