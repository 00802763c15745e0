"""What is asked of the service as a whole, and of its maps by name: the keys below admin/ of the contract."""

import logging
import secrets
from collections.abc import Callable
from typing import Any

from factorbus.proto import codec, keys
from factorbus.proto.problems import Internal, Problem, UnknownQuestion
from factorbus.proto.protocol import known
from factorbus.proto.version import __version__
from factorbus.service.bus.delivery import Delivery
from factorbus.service.bus.zenoh_session import ignore, payload_of
from factorbus.service.core.events import Asker
from factorbus.service.questions.admin import NotHere, read_budget, read_create, read_drop, read_fork
from factorbus.service.registry import Maps

log = logging.getLogger(__name__)


class Administration:
    """Answers on the control thread, which sends nothing itself to a peer that may not read."""

    def __init__(
        self, service: str, maps: Maps, delivery: Delivery, stats: Callable[[], dict[str, Any]], at_router: bool
    ) -> None:
        """stats: the answer to admin/stats.  at_router: other services may know what this one does not."""
        self._service, self._maps, self._delivery = service, maps, delivery
        self._stats, self._at_router = stats, at_router

    def answer(self, query: Asker) -> None:
        """Answer what `query` asks, at once or when it is done; leave it to others where it is theirs."""
        operation, payload = str(query.key_expr).removeprefix(keys.admin_key("")), payload_of(query)
        try:
            if operation in ("maps", "stats"):
                self._maps.open_new()
            if operation == "maps":
                told = {"maps": self._maps.rows(), "service": self._service, "version": __version__}
                self._delivery.answer(query, codec.encode_map(told | {"protocol": known()}))
            elif operation == "stats":
                self._delivery.answer(query, codec.encode_map(self._stats()))
            elif operation == "create":
                row = self._maps.create(*read_create(payload))
                self._delivery.answer(query, codec.encode_map(row | {"protocol": known()}))
            elif operation == "fork":
                self._maps.fork(query, read_fork(payload))
            elif operation == "drop":
                self._maps.drop(query, read_drop(payload))
            elif operation == "budget":
                self._maps.change_budget(query, read_budget(payload))
            elif self._at_router:
                ignore(query)
            else:
                raise UnknownQuestion(f"admin/{operation}", "maps, stats, create, fork, drop or budget")
        except NotHere as problem:
            if self._at_router:
                ignore(query)
            else:
                self._delivery.refuse(query, problem)
        except Problem as problem:
            self._delivery.refuse(query, problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: admin/%s", reference, operation)
            self._delivery.refuse(query, Internal(reference))
