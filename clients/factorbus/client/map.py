"""One map, as a client works with it."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

from numpy.typing import ArrayLike

from factorbus.client.arguments import checked_bound, checked_flag, checked_seconds, of_type
from factorbus.client.call_order import call_order, reading_ids
from factorbus.client.changes import Changes, some_of
from factorbus.client.draft import Draft, batch_of
from factorbus.client.interest_mirror import InterestMirror
from factorbus.client.key_numbers import Key, as_list
from factorbus.client.link import Link
from factorbus.client.map_row import MapRow
from factorbus.client.merging import Merged, as_trusted, fit_into
from factorbus.client.mirror import Mirror
from factorbus.client.pending_insert import PendingInsert, encoded, raise_unseen
from factorbus.client.present_clients import present_clients
from factorbus.client.questions import Questions, logged
from factorbus.client.renaming_kinds import saying_how_to_rename
from factorbus.client.request_sender import Request, RequestSender
from factorbus.client.smoothed_poses import BlendedPose, SmoothedPoses
from factorbus.client.supported import check_batch, check_changes, check_components, check_interest, check_suspects
from factorbus.client.uncertainty import Uncertainty, UncertaintyQuestions
from factorbus.client.window import Window
from factorbus.proto import keys
from factorbus.proto.asking import Repaired
from factorbus.proto.closures import Suspects
from factorbus.proto.components import Components
from factorbus.proto.interest import Interest
from factorbus.proto.messages import Accepted, Batch, Chi2, Estimate, Insert, MapGraph
from factorbus.proto.problems import ClosedHere, NoMirror, Problem, Refused, Unavailable
from factorbus.wording import counted

SUFFIX_LENGTH = 9  # characters that joining a map adds to the name of a client


class Map:
    """A map that this client has joined.  Close it, or use it in `with`.

    Inserts are numbered and sent until they are answered, each exactly once, in order, across restarts of the
    link.  They belong to the epoch that was joined: if the map is created anew (service restarted, map dropped),
    they are refused with wrong_epoch until `rejoin`; the mirror follows the new map by itself.

    uncertainty, marginals: what the map can be asked about its uncertainty.
    """

    def __init__(
        self, link: Link, sender: RequestSender, client: str, timeout_s: float, window: int, join: Callable[[], MapRow]
    ) -> None:
        self._link, self._sender, self._client, self.timeout_s = link, sender, client, timeout_s
        self._size, self._join = window, join
        self._stack, self._presence = ExitStack(), ExitStack()
        self._mirror: Mirror | None = None
        self._poses: SmoothedPoses | None = None
        self._lock = threading.RLock()  # entered itself, and not by its condition: see `interruptible_future.py`
        self._changed = threading.Condition(self._lock)
        self._sending, self._closed = threading.Lock(), False
        self._enter(join())
        self.ask = Questions(sender, self.name, timeout_s)
        self.uncertainty = self.marginals = Uncertainty(UncertaintyQuestions(sender, self.name, timeout_s))

    def __enter__(self) -> Map:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        try:
            if kind is None:
                self.flush()
        finally:
            self.close(quietly=True)

    @property
    def closed(self) -> bool:
        """This client has left the map."""
        return self._closed

    @property
    def estimate(self) -> Mirror:
        """The live estimate.  Raises Unavailable for a map opened with mirror=False."""
        if self._mirror is None:
            raise NoMirror(self.name)
        return self._mirror

    def pose(self, key: Key, smooth_s: float = 0.0) -> BlendedPose:
        """A pose of the live estimate, raw and with corrections blended over a time.  Raises NotHeld, BadOption."""
        with self._lock:
            poses = self._poses = self._poses or SmoothedPoses(self.estimate)
        return poses.pose(key, smooth_s)

    def insert(
        self,
        batch: Batch | Draft,
        *,
        settle: bool = False,
        convert_below: float = 0.0,
        changes: Changes | None = None,
        timeout_s: float | None = None,
    ) -> Accepted:
        """Add `batch` to the map and wait until it is in the estimate, the mirror included.

        convert_below: afterwards idp features whose linearity index is below this (0.1, say) become points.
        changes: are made first; all of it happens or none.

        Raises Refused: the map is as it was.  Raises Unavailable: see `PendingInsert.result`.  Raises as `send`.
        """
        end = time.monotonic() + checked_seconds("timeout_s", timeout_s, self.timeout_s)
        left = max(end - time.monotonic(), 0.0)
        pending_insert = self.send(batch, settle=settle, convert_below=convert_below, changes=changes, timeout_s=left)
        accepted = pending_insert.result(max(end - time.monotonic(), 0.0))
        self._catch_up(max(end - time.monotonic(), 0.0))
        return accepted

    def settle(self, timeout_s: float | None = None) -> Accepted:
        """Have the map iterate until it has converged.  Raises Refused, Unavailable."""
        return self.insert(Batch(), settle=True, timeout_s=timeout_s)

    def change(self, changes: Changes, *, settle: bool = False, timeout_s: float | None = None) -> Accepted:
        """Change what the map has: remove, weigh, fix, ...  Raises Refused (the map is as it was), Unavailable."""
        return self.insert(Batch(), changes=some_of(changes), settle=settle, timeout_s=timeout_s)

    def merge(
        self,
        other: MapGraph | Map,
        *,
        anchors: Batch | Draft | None = None,
        frame: ArrayLike | None = None,
        sigmas: ArrayLike | None = None,
        letters: Mapping[str, str] | None = None,
        absolute: str = "refuse",
        settle: bool = False,
        timeout_s: float | None = None,
    ) -> Merged:
        """Take all of the map `other` into this one, as one insert: all of it or nothing.

        other: a whole graph (`graph()` of a map on any service), or a map.  letters: of its keys, old to new.
        anchors: factors between variables of both, the other's under their new keys; among them a relative pose between
        a pose of each, by which values are brought into this map's frame (of several, the one that the others agree
        with best).  frame: where the other map's origin is in this one, x y θ or x y z qx qy qz qw, instead; where
        there are no anchors, a relative pose that says it is added between the poses that hold the maps, with `sigmas`.

        absolute: what the other knows of its own frame beyond one fixed pose or one prior of a pose, which are left
        out.  "refuse" if there is more (AbsoluteFactors); "leave_out" all of it, fixed variables are estimated; "keep"
        it, if both maps have one frame: nothing is transformed then, and anchors are not needed.

        Raises KeyCollision, NoAnchor, AbsoluteFactors, CannotMerge, BadSymbol, TooLarge: nothing was sent.  Raises
        Refused (the map is as it was; `kind_taken`: see `rename_kinds`), Unavailable.
        """
        if not isinstance(other, MapGraph):
            other = of_type("other", other, Map, "a Map, or the MapGraph of one").graph(timeout_s)
        here = self.ask_estimate(timeout_s=timeout_s)
        fitted = fit_into(here, other, anchors=anchors, frame=frame, sigmas=sigmas, letters=letters, absolute=absolute)
        with saying_how_to_rename():
            batch = as_trusted(fitted.batch) if self.closures != "trust" else fitted.batch
            return Merged(self.insert(batch, settle=settle, timeout_s=timeout_s), fitted)

    def send(
        self,
        batch: Batch | Draft,
        *,
        settle: bool = False,
        convert_below: float = 0.0,
        changes: Changes | None = None,
        timeout_s: float | None = None,
    ) -> PendingInsert:
        """Send `batch` without waiting for its answer.  Waits only while `window` inserts are unanswered.

        Raises Unavailable if the window stays full for `timeout_s`, TooLarge, NotSupported, BadOption: nothing is sent.
        """
        batch, order, settle = batch_of("batch", batch), call_order(batch), checked_flag("settle", settle)
        changes = Changes() if changes is None else of_type("changes", changes, Changes, "a Changes")
        check_batch(self._protocol, batch)
        below = checked_bound("convert_below", convert_below)
        timeout_s = checked_seconds("timeout_s", timeout_s, self.timeout_s)
        with self._sending:  # keeps the order of the numbers on the wire; callbacks of the bus never take it
            with self._lock:
                self._wait_for_room(timeout_s)
            listed = changes.listed_in(self.name, self.epoch)
            check_changes(self._protocol, listed)
            insert = Insert(self._window.next, batch, settle, self.epoch, below, listed)
            pending_insert = self._pending_insert(insert, order, timeout_s)
            with self._lock:
                self._window.sent(pending_insert)
            self._sender.carry(pending_insert.request)
        return pending_insert

    def flush(self, timeout_s: float | None = None) -> None:
        """Wait until everything sent is answered, and the mirror has it.

        Raises Unavailable when time is up, and the first refusal that nobody has looked at, with its `others`.
        """
        timeout_s = checked_seconds("timeout_s", timeout_s, self.timeout_s)
        with self._lock:
            if not self._changed.wait_for(lambda: self._window.idle, timeout_s):
                left = len(self._window.unanswered)
                raise Unavailable(
                    f"map {self.name!r}", timeout_s, f"{counted(left, 'insert')} without an answer, still being sent"
                )
            refused = self._window.take_refused()
        raise_unseen(refused)
        self._catch_up(timeout_s)

    def wait_converged(self, timeout_s: float | None = None) -> None:
        """Wait until everything sent is answered and the map, left alone since, goes on no more by itself.

        It is at its optimum then, to 1e-6 of χ², or within a thousandth where `stats()["gave_up"]` says why.  Nothing
        is sent for it: a map goes on by itself within a second.  `settle` demands it at once, as a step.
        Raises NotConverged when time is up, or where the map gave up; Unavailable with mirror=False; as `flush` does.
        """
        end = time.monotonic() + checked_seconds("timeout_s", timeout_s, self.timeout_s)
        self.flush(max(end - time.monotonic(), 0.0))
        self.estimate.wait_converged(max(end - time.monotonic(), 0.0))

    def rejoin(self) -> int:
        """Join the map as it is now, creating it if need be, and return its epoch; numbering starts again.

        What is unanswered fails with Unavailable: look into the estimate for what the map already has.
        """
        self._check_open()
        with self._sending:
            self._give_up("the client joined the map anew first; see in the estimate whether it arrived")
            self._enter(self._join())
        return self.epoch

    def ask_estimate(
        self,
        of: Sequence[Key] | Key | None = None,
        *more: Key,
        timeout_s: float | None = None,
        interest: Interest | None = None,
    ) -> Estimate:
        """Values from the service at one revision: all, of some variables, or of those in `interest`.

        Raises Refused, Unavailable, BadOption, UnknownKind, NotSupported.
        """
        if interest is not None:
            check_interest(self._protocol)
        return self.ask.estimate(as_list("ask_estimate", of, more), timeout_s, interest).result()

    def chi2(self, batch: bool = False, *, timeout_s: float | None = None, values: bool = False) -> Chi2:
        """Σ rᵀΩr of the estimate; with `batch` also of the optimum found from scratch, with `values` that itself.

        Where the map is above it by more than 1 % the answer's `notice` says so (`better_optimum`), and
        `change(Changes().adopt(answer), settle=True)` puts the map there.  `batch_converged` is false where the search
        ended before: the optimum may be lower.  Raises Refused, Unavailable.
        """
        return self.ask.chi2(batch, timeout_s, values).result()

    def repair(
        self, factors: Sequence[int] | int | None = None, *, probability: float = 0.99, timeout_s: float | None = None
    ) -> Repaired:
        """Which factors (ids; None: of all that close loops) are false; nothing is changed yet.

        probability: with which a right one is kept.  `change(Changes().repair(answer), settle=True)` applies it.
        Raises Refused, Unavailable.
        """
        return self.ask.repair(factors, probability, timeout_s).result()

    def suspects(self, every: bool = False, *, timeout_s: float | None = None) -> Suspects:
        """Loop closures that the estimate does not have, or `every` one: of a map that tests them.

        Raises Refused, Unavailable, NotSupported.
        """
        check_suspects(self._protocol)
        return self.ask.suspects(every, timeout_s).result()

    def components(self, timeout_s: float | None = None) -> Components:
        """Which parts of the map no factor joins, such as a robot's that is not attached yet, and what holds each.

        Raises Refused, Unavailable, NotSupported.
        """
        check_components(self._protocol)
        return self.ask.components(timeout_s).result()

    def graph(self, timeout_s: float | None = None) -> MapGraph:
        """The whole map: variables with present values, and factors.  Raises Refused, Unavailable."""
        return self.ask.graph(timeout_s).result()

    def stats(self, timeout_s: float | None = None) -> dict[str, Any]:
        """What the service counts and times about this map.  Raises Refused, Unavailable."""
        return self.ask.stats(timeout_s).result()

    def clients(self, timeout_s: float | None = None) -> set[str]:
        """Names of the clients that have joined the map and not left it, of those that tell; this one is among them."""
        return present_clients(self._link, self.name, checked_seconds("timeout_s", timeout_s, self.timeout_s))

    def export(
        self, format: str = "g2o", *, timeout_s: float | None = None, robot: str | None = None, strict: bool = False,
        ids: str = "auto",
    ) -> str:  # fmt: skip
        """The map as the text of a file: "g2o", "pyfg", "jrl", "tum" or "kitti".

        robot: the letter of the robot whose trajectory it is ("" for keys without one), if the map has several.  What
        a form has no record for is left out and logged, and with `strict` refused; `ask.export` gives it as notes.
        ids: of a g2o file, "auto" (numbers if x and l are all the letters, else keys), "ids", "keys" or "counted".
        Raises Refused, Unavailable.
        """
        return logged(self.name, self.ask.export(format, timeout_s, robot, strict, ids).result())

    def close(self, *, quietly: bool = False) -> list[tuple[PendingInsert, Problem]]:
        """Leave the map.  What is unanswered fails with Unavailable; `flush` first, or leave `with`, to wait.  Raises
        the first refusal, or insert without an answer, that nobody has looked at; quietly it gives all there are.
        """
        with self._lock:
            already, self._closed = self._closed, True
            self._changed.notify_all()
        if already:
            return []
        with self._sending:
            self._give_up("the map was closed first")
        self._presence.close()
        self._stack.close()
        refused = self._window.take_refused()
        raise_unseen([] if quietly else refused)
        return refused

    def open_mirror(self, interest: Interest | None = None) -> None:
        """Start the live estimate, or that of a part, and wait for it.  Raises Unavailable, NotSupported, Refused."""
        self._check_open()
        if interest is not None:
            check_interest(self._protocol)
            self._mirror = InterestMirror(self._link, self.name, self.timeout_s, interest)
        else:
            self._mirror, row = Mirror(self._link, self.name, self.timeout_s), self._row
            if row.converged or row.converging:  # neither: the map gave up, and the row does not say why
                self._mirror.expect_convergence(row.epoch, row.revision, bool(row.converged), row.converging)
        self._mirror.start(self._stack)

    def watch_owner(self) -> None:
        """Notice when the map's service goes and comes, so that nothing waits longer than it must."""
        self._stack.enter_context(self._link.watching(f"{keys.map_root(self.name)}/live/service/*", self._see_owner))

    def _enter(self, row: MapRow) -> None:
        """Take part in the map as `row` describes it, under a name of our own.

        The suffix makes the name that of one handle, of which numbers start at 1, though processes may have one name.
        """
        self.name, self.mode, self.epoch, self.closures = row.name, row.mode, row.epoch, row.closures
        self._row, self._protocol = row, row.protocol
        self.client = f"{self._client}-{os.urandom(4).hex()}"
        self._key = keys.insert_key(self.name, self.client)
        self._window: Window[PendingInsert] = Window(self._size)
        self._presence.close()
        self._presence.enter_context(self._link.present(keys.client_token(self.name, self.client)))

    def _pending_insert(self, insert: Insert, order: Sequence[int], timeout_s: float) -> PendingInsert:
        window = self._window

        def then(_: Request, result: Any) -> None:
            if isinstance(result, Accepted) and self._mirror is not None:
                self._mirror.expect(result.revision, result.epoch)
            with self._lock:
                window.answered(insert.sequence, result if isinstance(result, Problem) else None)
                self._changed.notify_all()

        def passing(refused: Refused) -> bool:
            # It overtook its predecessor, which is still being sent: the service did not use up its number.
            wanted = refused.detail.get("next")
            return refused.code == "bad_sequence" and type(wanted) is int and window.waits_for(insert.sequence, wanted)

        what, read = f"map {self.name!r}", reading_ids(order)
        sent = Request(what, self._key, encoded(insert), read, passing=passing, then=then)
        return PendingInsert(sent, insert.sequence, timeout_s)

    def _catch_up(self, timeout_s: float) -> None:
        """Let the mirror reach what has been accepted; if it does not, it says that it is stale."""
        if self._mirror is not None:
            self._mirror.catch_up(timeout_s)

    def _wait_for_room(self, timeout_s: float) -> None:
        room = self._changed.wait_for(lambda: self._closed or not self._window.full, timeout_s)
        self._check_open()
        if not room:
            hint = f"{counted(self._size, 'insert')} without an answer (window={self._size}); this one was not sent"
            raise Unavailable(f"map {self.name!r}", timeout_s, hint)

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedHere(f"map {self.name!r}", connection=self._link.closed)

    def _give_up(self, hint: str) -> None:
        """Under `_sending`."""
        with self._lock:
            unanswered = self._window.unanswered
        for pending_insert in unanswered:
            waited_s = round(time.perf_counter() - pending_insert.request.sent_at, 3)
            self._sender.abandon(pending_insert.request, Unavailable(f"map {self.name!r}", waited_s, hint))

    def _see_owner(self, token: str, alive: bool) -> None:
        if self._mirror is not None:
            self._mirror.owner(token, alive)
        if alive:
            self._sender.hurry(keys.map_root(self.name) + "/")
