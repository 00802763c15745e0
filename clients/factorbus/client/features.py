"""New features for a monocular filter: pixels go to a service and its workers, a grown state and covariance come back.

    with connect("tcp/127.0.0.1:7447", client="camera1") as bus, bus.features(camera, rho=0.5, sigma_rho=0.25) as front:
        x, P = front.grow(x, P, pixels).state

The filter's state begins with the camera: r (3), q (4, scalar first, camera to world), v (3), ω (3); new features are
appended, six numbers each.  No map is involved, and no compiler is needed here.
"""

import threading
import time
from concurrent.futures import Future
from contextlib import ExitStack

from numpy.typing import ArrayLike

from factorbus.client.arguments import as_numbers, checked_number, checked_seconds
from factorbus.client.filter_state import Factored, FilterState, augmented, factored
from factorbus.client.link import Link
from factorbus.client.request_sender import Request, RequestSender
from factorbus.client.shared_memory_pool import SharedAllocation, SharedMemoryPool
from factorbus.client.versions import refuse_other_protocol
from factorbus.proto import keys
from factorbus.proto.arrays import F64
from factorbus.proto.camera import Camera
from factorbus.proto.features import (
    CAMERA_STATE,
    FEATURE,
    Ask,
    FeaturesAnswer,
    Observations,
    answer_size,
    new_rows_size,
)
from factorbus.proto.features_codec import decode_answer, encode_ask
from factorbus.proto.limits import ANSWER_LIMITS
from factorbus.proto.problems import BadShape, Refused, TooLarge, Unavailable
from factorbus.proto.segments import PAGE
from factorbus.wording import counted

# A smaller answer is sooner sent than shared memory is made for it.
_SHARED_FROM_BYTES = 64 << 10
# No service for so long is worth a look for services of other versions of the protocol.
_LOOK_AFTER_S = 0.3


class Features:
    """Where a front end with one camera has its features made.  Close it, or use it in `with`.

    camera: with its lens.  rho, sigma_rho: prior of every feature's inverse distance (1/metre).  sigma_pixel: standard
    deviation of u and of v (pixels).  service: its name; empty: whichever answers.
    """

    def __init__(
        self,
        link: Link,
        sender: RequestSender,
        timeout_s: float,
        camera: Camera,
        *,
        rho: float = 1.0,
        sigma_rho: float = 1.0,
        sigma_pixel: float = 1.0,
        service: str = "",
    ) -> None:
        self.camera = camera
        self.rho, self.sigma_rho, self.sigma_pixel = (
            checked_number(name, given)
            for name, given in (("rho", rho), ("sigma_rho", sigma_rho), ("sigma_pixel", sigma_pixel))
        )
        self._link, self._sender, self._timeout_s, self._service = link, sender, timeout_s, service
        self._pool = SharedMemoryPool()
        self._shared = True  # until an answer shows that nobody there shares memory with us
        self._stack = ExitStack()
        self._lock = threading.RLock()  # entered itself, and not by its condition: see `interruptible_future.py`
        self._changed = threading.Condition(self._lock)
        self._services: set[str] = set()
        self._stack.enter_context(link.watching(keys.any_features_token(), self._see))

    def __enter__(self) -> "Features":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def shares_memory(self) -> bool:
        """Whether the next large answer may come in shared memory: until one has shown that nobody there shares any."""
        return self._shared

    def grow(self, x: ArrayLike, P: ArrayLike, pixels: ArrayLike, *, timeout_s: float | None = None) -> FilterState:
        """State and covariance with a new feature for each pixel, and wait for them.

        x (m,), P (m, m): as they are.  pixels (n, 2): distorted, u v.
        Raises BadShape, TooLarge, Unavailable, and Refused with bad_pixel, bad_state, bad_camera: nothing was added.
        """
        return self.send(x, P, pixels, timeout_s=timeout_s).result()

    def send(self, x: ArrayLike, P: ArrayLike, pixels: ArrayLike, *, timeout_s: float | None = None) -> "Growing":
        """The same without waiting: several may be on their way.  x and P must not be changed until `result`."""
        state, covariance = _matching(x, P)
        observations = self._observations(state, covariance, pixels)
        m, n = observations.width, observations.count
        allocation = None
        if self._shared and new_rows_size(n, m) >= _SHARED_FROM_BYTES:
            allocation = self._pool.try_allocate(PAGE, (m + FEATURE * n, m + FEATURE * n), m)
        ask = Ask(observations, "rows", allocation.segment) if allocation else Ask(observations, "half")
        return Growing(self, state, covariance, ask, allocation, self._ask(ask, timeout_s))

    def factor(self, x: ArrayLike, P: ArrayLike, pixels: ArrayLike, *, timeout_s: float | None = None) -> Factored:
        """The new features as factors: O(m + n) numbers, from which any block of the covariance is formed on demand.

        Of P, its first 13 rows will do.  Raises as `grow`.
        """
        state, covariance = as_numbers("x", x, copy=False), as_numbers("P", P, copy=False)
        observations = self._observations(state, covariance, pixels)
        answer: FeaturesAnswer = self._ask(Ask(observations, "factored"), timeout_s).future.result()
        return factored(observations, answer)

    def close(self) -> None:
        """Ask nothing more."""
        self._stack.close()
        self._pool.close()

    def settle(self, allocation: SharedAllocation, clean: bool, stored: bool) -> None:
        """For Growing: what became of the memory of an answer."""
        self._shared &= stored
        self._pool.settle(allocation, clean)

    def again_without_memory(self, ask: Ask, timeout_s: float | None = None) -> Request:
        """For Growing: the same question, for somebody who shares no memory with us."""
        self._shared = False
        return self._ask(Ask(ask.observations, "half"), timeout_s)

    def _observations(self, x: F64, P: F64, pixels: ArrayLike) -> Observations:
        seen = as_numbers("pixels", pixels, copy=False)
        if seen.ndim != 2 or seen.shape[1] != 2:
            raise BadShape("pixels", " × ".join(map(str, seen.shape)), "n × 2")
        if x.ndim != 1 or x.size < CAMERA_STATE or P.ndim != 2 or P.shape[0] < CAMERA_STATE or P.shape[1] != x.size:
            raise BadShape("x and P", f"{x.shape} and {P.shape}", "(m,) and (m, m) with m ≥ 13, the camera first")
        state, rows = x[:CAMERA_STATE], P[:CAMERA_STATE]
        return Observations(self.camera, state, rows, seen, self.rho, self.sigma_rho, self.sigma_pixel)

    def _ask(self, ask: Ask, timeout_s: float | None) -> Request:
        self._link.check_open("features")
        timeout_s = checked_seconds("timeout_s", timeout_s, self._timeout_s)
        if answer_size(ask) > ANSWER_LIMITS.max_bytes:
            raise TooLarge(
                "the answer", answer_size(ask), ANSWER_LIMITS.max_bytes, "bytes", "ask for fewer features at a time"
            )
        started = time.monotonic()
        service = self._service or self._any_service(timeout_s)
        left = max(0.001, timeout_s - (time.monotonic() - started))
        what = f"service {service}, asked for {counted(ask.observations.count, 'feature')},"
        return self._sender.carry(Request(what, keys.features_key(service), encode_ask(ask), decode_answer, left))

    def _any_service(self, timeout_s: float) -> str:
        with self._lock:
            if self._changed.wait_for(lambda: self._services, min(timeout_s, _LOOK_AFTER_S)):
                return min(self._services)
        refuse_other_protocol(self._link, timeout_s)
        with self._lock:
            if not self._changed.wait_for(lambda: self._services, max(0.0, timeout_s - _LOOK_AFTER_S)):
                raise Unavailable("features", timeout_s, "no service on this bus makes features: is one running?")
            return min(self._services)

    def _see(self, token: str, alive: bool) -> None:
        with self._lock:
            (self._services.add if alive else self._services.discard)(keys.service_of(token))
            self._changed.notify_all()


class Growing:
    """A filter's growth that is on its way."""

    def __init__(
        self, features: Features, x: F64, P: F64, ask: Ask, allocation: SharedAllocation | None, request: Request
    ) -> None:
        self._features, self._x, self._P, self._ask, self._allocation = features, x, P, ask, allocation
        self._request = request
        self._result: FilterState | None = None

    @property
    def future(self) -> Future[FeaturesAnswer]:
        """For callbacks and asyncio: it is done when `result` need not wait for the bus."""
        return self._request.future

    def result(self) -> FilterState:
        """Wait for it, and put it together on this thread.  Raises as `Features.grow`."""
        if self._result is None:
            self._result = self._put_together()
        return self._result

    def _put_together(self) -> FilterState:
        try:
            answer = self._request.future.result()
        except Refused as refused:
            if self._allocation is None or refused.code != "too_large":
                self._settle(clean=False, stored=True)
                raise
            # Nobody there could store it, and as rows it is too large to send; as the upper half it may not be.
            self._settle(clean=False, stored=False)
            self._allocation = None
            answer = self._features.again_without_memory(self._ask).future.result()
        except BaseException:
            self._settle(clean=False, stored=True)
            raise
        matrix = self._allocation.matrix if self._allocation else None
        result = augmented(self._x, self._P, self._ask.observations, answer, matrix)
        stored = all(done.shard.stored for done in answer.shards)
        self._settle(clean=answer.clean and self._request.attempt == 1, stored=stored)
        return result

    def _settle(self, clean: bool, stored: bool) -> None:
        allocation, self._allocation = self._allocation, None
        if allocation is not None:
            self._features.settle(allocation, clean, stored)


def _matching(x: ArrayLike, P: ArrayLike) -> tuple[F64, F64]:
    state, covariance = as_numbers("x", x, copy=False), as_numbers("P", P, copy=False)
    if state.ndim != 1 or covariance.shape != (state.size, state.size):
        raise BadShape("x and P", f"{state.shape} and {covariance.shape}", "(m,) and (m, m)")
    return state, covariance
