"""The messages of inverse-depth features as frozen values: what a filter front end asks and what it gets.

A feature is y = (x y z, θ, φ, ρ): where the camera was when it was first seen (metres, world), azimuth and elevation of
its ray (radians, world: y points down), inverse distance along the ray (1/metre).  The camera's state is x_v = (r (3,
metres), q (4, scalar first, camera to world), v (3), ω (3)), and it stands first in the filter's state.
`proto/README.md` has the wire, `workers/MATH.md` the equations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from factorbus.proto.arrays import F64
from factorbus.proto.camera import Camera
from factorbus.proto.problems import Problem

CAMERA_STATE = 13
FEATURE = 6
# What an answer holds: whole rows of the new features, only the upper half of their blocks, or factors of them.
FORMS = ("rows", "half", "factored")


class BadPixel(Problem):
    """A pixel without a usable ray: the whole request is refused."""

    code = "bad_pixel"

    def __init__(self, index: int, u: float, v: float, reason: str) -> None:
        super().__init__(
            f"pixel {index} at ({u:.6g}, {v:.6g}): {reason}; leave it out and ask again", index=index, reason=reason
        )


class BadState(Problem):
    """A camera state, covariance or prior that cannot be."""

    code = "bad_state"

    def __init__(self, where: str, seen: object, wanted: str) -> None:
        super().__init__(f"{where} is {seen}; wanted {wanted}", where=where)


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Pixels seen for the first time, and what the filter knows of the camera that saw them.

    state (13,): x_v.  covariance (13, m): the camera's rows of P, of as many columns as the filter's state has numbers.
    pixels (n, 2): u v, distorted.  rho, sigma_rho: the prior of every feature's inverse distance (1/metre).
    sigma_pixel: standard deviation of u and of v (pixels).
    """

    camera: Camera
    state: F64
    covariance: F64
    pixels: F64
    rho: float = 1.0
    sigma_rho: float = 1.0
    sigma_pixel: float = 1.0

    @property
    def count(self) -> int:
        """How many features, n."""
        return len(self.pixels)

    @property
    def width(self) -> int:
        """How many numbers the filter's state has, m."""
        return self.covariance.shape[1]


class Segment(NamedTuple):
    """Memory that both ends can reach: a file of `size` bytes in /dev/shm, which begins with the 16 bytes `nonce`."""

    name: str
    nonce: bytes
    size: int


class Ask(NamedTuple):
    """A filter front end's question: the features of `sighting`, in one of FORMS; rows into `segment` if given."""

    sighting: Sighting
    form: str = "rows"
    segment: Segment | None = None


class Shard(NamedTuple):
    """Work for one worker: features first .. last−1 of the question."""

    ask: Ask
    first: int
    last: int


class ShardDone(NamedTuple):
    """Features first .. last−1 of a question, k of them.  Arrays that the form does not have are empty.

    y (k, 6).
    rows: P(new, (before, new)) of these features, (6 k, m + 6 n); empty when it was written to the segment (`stored`).
    half: cross (6 k, m) = P(new, before); blocks: for each feature i its P(new i, new i .. n−1), 6 × 6 (n − i), one
    after the other.
    factored: turn (k, 4), own (k, 3), shared (6 m + 9,), the same in every shard: U (6, m) and S (3, 3).
    """

    first: int
    last: int
    y: F64
    rows: F64
    cross: F64
    blocks: F64
    turn: F64
    own: F64
    shared: F64
    stored: bool = False


class Answered(NamedTuple):
    """The answer to an Ask: its shards in the order of their features, who did each, and how long that took there."""

    shards: Sequence[ShardDone]
    workers: Sequence[str]
    seconds: float
