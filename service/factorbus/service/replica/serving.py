"""What a service does for its replicas: tells them its records, and takes theirs."""

import logging
import secrets
from collections.abc import Callable
from typing import Any

from factorbus.journal.records import Last
from factorbus.journal.store import open_store
from factorbus.proto.problems import Internal, Problem, TooLarge
from factorbus.proto.records import (
    MOST_RECORDS,
    JournalPlace,
    RecordsAnswer,
    decode_records_ask,
    decode_records_push,
    encode_records_answer,
)
from factorbus.service.config import Limits
from factorbus.service.core.events import Asker
from factorbus.service.journal.grafting import Graft, sent_records
from factorbus.service.journal.keeping import Keeper
from factorbus.service.journal.record_problems import NotRecorded, OtherRecords
from factorbus.service.maps.host import Host
from factorbus.service.maps.serial_executor import SerialExecutor
from factorbus.service.solving.arrival import message_digest

log = logging.getLogger(__name__)


class RecordServing:
    """Questions for records, and records of replicas, on a thread of their own.

    reply, refuse: answer a query.  no_room: why a message of that many bytes cannot be taken, if there is a reason.
    """

    def __init__(
        self,
        limits: Limits,
        reply: Callable[[Asker, bytes], None],
        refuse: Callable[[Asker, Any], None],
        no_room: Callable[[int], Problem | None],
    ) -> None:
        self.executor = SerialExecutor("records")
        self._limits, self._reply, self._refuse, self._no_room = limits, reply, refuse, no_room

    def ask(self, query: Asker, host: Host, payload: bytes) -> None:
        """What came after a place.  Returns at once, as `take` does."""
        self.executor.hand(self._guarded, query, lambda: self._answered(query, host, payload))

    def take(self, query: Asker, host: Host, payload: bytes) -> None:
        """Records of a replica."""
        self.executor.hand(self._guarded, query, lambda: self._taken(query, host, payload))

    def close(self) -> None:
        """Return when all is answered, or with the maps."""
        self.executor.close()

    def _guarded(self, query: Asker, do: Callable[[], None]) -> None:
        try:
            do()
        except Problem as problem:
            self._refuse(query, problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: records", reference)
            self._refuse(query, Internal(reference))

    def _answered(self, query: Asker, host: Host, payload: bytes) -> None:
        asked, keeper, last = decode_records_ask(payload, self._limits.message()), _keeper(host), _keeper(host).last
        name, after = host.core.name, asked.after.record
        records, end, more = (), last, False
        if asked.after != (last.record, last.chain):
            if after > last.record:
                raise OtherRecords(name, last.record, after)
            store = open_store(keeper.folder, read_only=True)
            try:
                here = store.last_at(after) if after else Last(0, 0, JournalPlace().chain)
                if here.chain != asked.after.chain:
                    raise OtherRecords(name, last.record, after)
                named, coming = frozenset(asked.named), store.records(after)
                records, sent, more = sent_records(coming, named, asked.most_bytes, MOST_RECORDS)
                end = sent or here
            finally:
                store.close()
        place = JournalPlace(end.record, end.chain)
        self._reply(query, encode_records_answer(RecordsAnswer(host.core.epoch, place, records, more)))

    def _taken(self, query: Asker, host: Host, payload: bytes) -> None:
        _keeper(host)
        push = decode_records_push(payload, message_digest, self._limits.message_bytes)
        variables, most = host.core.variables, self._limits.variables
        if variables >= most:
            raise TooLarge(f"map {host.core.name}", variables + 1, most, "variables")
        if (full := self._no_room(len(payload))) is not None:
            raise full
        host.graft(query, Graft(push.after, push.records))


def _keeper(host: Host) -> Keeper:
    """What writes the journal of the map.  Raises NotRecorded."""
    if host.keeper is None:
        raise NotRecorded(host.core.name)
    return host.keeper
