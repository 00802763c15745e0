"""Questions to a map: each method sends one and returns the future of its answer."""

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple, TypeVar

from factorbus.client.arguments import checked_flag, checked_probability, checked_seconds, of_type
from factorbus.client.key_numbers import Key, id_numbers, key_numbers
from factorbus.client.request_sender import Request, RequestSender
from factorbus.proto import codec, fields, keys
from factorbus.proto.asking import AskRepair, Repaired
from factorbus.proto.closures import AskSuspects, Suspects, decode_suspects, encode_ask_suspects
from factorbus.proto.components import Components, decode_components
from factorbus.proto.interest import Interest, checked_interest
from factorbus.proto.interest_codec import filter_map
from factorbus.proto.messages import Chi2, Estimate, MapGraph
from factorbus.proto.problems import BadMessage
from factorbus.proto.repair_codec import decode_repaired, encode_ask_repair
from factorbus.proto.step_history import StepHistory, decode_step_history

T = TypeVar("T")
log = logging.getLogger("factorbus.client")


class Exported(NamedTuple):
    """A map as the text of a file.

    notes: what the format has no record for and was left out, or says less there, for people.  left_out: how many of
    each kind those are; None: the service is an older one, which does not say.
    """

    text: str
    notes: tuple[str, ...]
    left_out: Mapping[str, int] | None = None


class Questions:
    """What one map can be asked.  The futures get the answer, Refused, or Unavailable after `timeout_s`."""

    def __init__(self, sender: RequestSender, map_name: str, timeout_s: float) -> None:
        self._sender, self._map, self._timeout_s = sender, map_name, timeout_s

    def estimate(
        self, of: Sequence[Key] | Key | None, timeout_s: float | None, interest: Interest | None = None
    ) -> Future[Estimate]:
        """Values at one revision: all, or of some variables."""
        payload = codec.encode_keys_asked(None if of is None else key_numbers(of))
        if interest is not None:
            part = checked_interest(of_type("interest", interest, Interest, "an Interest"))
            payload = codec.encode_map(codec.decode_map(payload) | filter_map(part))
        return self._ask("estimate", payload, codec.decode_estimate, timeout_s)

    def chi2(self, batch: bool, timeout_s: float | None, values: bool = False) -> Future[Chi2]:
        """Σ rᵀΩr; with `batch` also of the optimum from scratch, for which a worker gets `timeout_s`; or all of it."""
        timeout_s = checked_seconds("timeout_s", timeout_s, self._timeout_s)
        question = {"batch": checked_flag("batch", batch), "timeout_s": timeout_s}
        question |= {"values": True} if checked_flag("values", values) else {}
        return self._ask("chi2", codec.encode_map(question), codec.decode_chi2, timeout_s)

    def graph(self, timeout_s: float | None) -> Future[MapGraph]:
        """Variables with present values, and factors."""
        return self._ask("graph", codec.encode_map({}), codec.decode_graph, timeout_s)

    def stats(self, timeout_s: float | None) -> Future[dict[str, Any]]:
        """What the service counts and times about the map."""
        return self._ask("stats", codec.encode_map({}), codec.decode_map, timeout_s)

    def history(self, timeout_s: float | None = None) -> Future[StepHistory]:
        """χ², time and work of the steps since the service has opened the map, the more sparsely the longer ago."""
        return self._ask("history", codec.encode_map({}), decode_step_history, timeout_s)

    def export(
        self,
        format: str,
        timeout_s: float | None,
        robot: str | None = None,
        strict: bool = False,
        ids: str = "auto",
    ) -> Future[Exported]:
        """The map as the text of a file, and what was left out of it."""
        question: dict[str, Any] = {"format": format, "strict": checked_flag("strict", strict), "ids": ids}
        question |= {} if robot is None else {"robot": robot}
        return self._ask("export", codec.encode_map(question), _exported, timeout_s)

    def repair(
        self, factors: Sequence[int] | int | None, probability: float, timeout_s: float | None
    ) -> Future[Repaired]:
        """Which factors are false, and the estimate without them."""
        chosen = None if factors is None else id_numbers("repair", factors)
        question = encode_ask_repair(AskRepair(chosen, checked_probability("probability", probability), values=True))
        return self._ask("repair", question, decode_repaired, timeout_s)

    def suspects(self, every: bool, timeout_s: float | None) -> Future[Suspects]:
        """Loop closures that the estimate does not have, or all of them."""
        question = encode_ask_suspects(AskSuspects(checked_flag("every", every)))
        return self._ask("suspects", question, decode_suspects, timeout_s)

    def components(self, timeout_s: float | None) -> Future[Components]:
        """Which parts of the map no factor joins."""
        return self._ask("components", codec.encode_map({}), decode_components, timeout_s)

    def _ask(self, question: str, payload: bytes, decode: Callable[[bytes], T], timeout_s: float | None) -> Future[T]:
        what = f"map {self._map!r}, asked for its {question},"
        key = keys.ask_key(self._map, question)
        timeout_s = checked_seconds("timeout_s", timeout_s, self._timeout_s)
        return self._sender.carry(Request(what, key, payload, decode, timeout_s)).future


def logged(name: str, exported: Exported) -> str:
    """The text alone; what was left out of it goes to the log."""
    for note in exported.notes:
        log.warning("export of map %r: %s", name, note)
    return exported.text


def _exported(data: bytes) -> Exported:
    content = codec.decode_map(data)
    text, notes = content.get("text"), content.get("notes", [])
    if not isinstance(text, str):
        raise BadMessage("export.text", "missing or not a string", "a string")
    if not (isinstance(notes, list) and all(isinstance(note, str) for note in notes)):
        raise BadMessage("export.notes", "not strings", "an array of strings")
    if "left_out" not in content:
        return Exported(text, tuple(notes))
    counts = fields.mapping("export", content, "left_out")
    return Exported(text, tuple(notes), {str(name): fields.integer("export.left_out", counts, name) for name in counts})
