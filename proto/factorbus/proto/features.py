"""The messages of inverse-depth features as frozen values: what a filter front end asks and what it gets.

A feature is y = (x y z, θ, φ, ρ): where the camera was when it was first seen (metres, world), azimuth and elevation of
its ray (radians, world: y points down), inverse distance along the ray (1/metre).  The camera's state is x_v = (r (3,
metres), q (4, scalar first, camera to world), v (3), ω (3)), and it stands first in the filter's state.
`proto/README.md` has the wire, `workers/MATH.md` the equations.
"""

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
        super().__init__(f"{where} is {seen}; wanted {wanted}", where=where, seen=str(seen), wanted=wanted)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
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
    """Shared memory for an answer: `descriptor` of `process` is a file of `size` bytes that begins with `nonce`.

    The rows of the form `rows` are written from byte `offset` on.
    """

    process: int
    descriptor: int
    nonce: str
    size: int
    offset: int


class Ask(NamedTuple):
    """A filter front end's question: the features of `observations`, in one of FORMS; rows into `segment` if given."""

    observations: Observations
    form: str = "rows"
    segment: Segment | None = None


class Shard(NamedTuple):
    """Work for one worker: features first .. last−1 of a question, which comes as the bytes it had."""

    ask: bytes
    first: int
    last: int


class ShardDone(NamedTuple):
    """Features first .. last−1 of a question, k of them.  Arrays that the form does not have are None.

    y (k, 6).
    rows: P(new, (before, new)) of these features, (6 k, m + 6 n); None, too, where they are in the segment (`stored`).
    half: cross (6 k, m) = P(new, before); blocks: for each feature i its P(new i, new i .. n−1), 6 × 6 (n − i), one
    after the other.
    factored: turn (k, 4), own (k, 3), and the same in every shard U (6, m) and S (3, 3).
    """

    first: int
    last: int
    y: F64
    rows: F64 | None = None
    cross: F64 | None = None
    blocks: F64 | None = None
    turn: F64 | None = None
    own: F64 | None = None
    U: F64 | None = None
    S: F64 | None = None
    stored: bool = False


class Done(NamedTuple):
    """A shard as it was done: by whom ("in-place": the service), and how long it took there."""

    shard: ShardDone
    worker: str
    seconds: float


class FeaturesAnswer(NamedTuple):
    """The answer to an Ask: its shards in the order of the features.

    clean: everybody who was given a part has answered for it, so nobody will write to the segment any more.
    """

    shards: tuple[Done, ...]
    clean: bool


def answer_size(ask: Ask) -> int:
    """Bytes of the numbers in the answer to `ask`, beyond those that go to its segment."""
    n, m = ask.observations.count, ask.observations.width
    if ask.form == "factored":
        return 8 * (13 * n + 6 * m + 9)
    if ask.form == "half":
        return 8 * (6 * n + 6 * n * m + 36 * n * (n + 1) // 2)
    return 8 * 6 * n + (0 if ask.segment else new_rows_size(n, m))


def new_rows_size(n: int, m: int) -> int:
    """Bytes of the whole new rows."""
    return 8 * 6 * n * (m + 6 * n)
