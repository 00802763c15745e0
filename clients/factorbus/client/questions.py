"""Questions to a map: each method sends one and returns the future of its answer."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, TypeVar

import numpy as np

from factorbus.client.courier import Courier, Errand
from factorbus.client.draft import Key
from factorbus.proto import codec, keys
from factorbus.proto.asking import AskRepair, Repaired
from factorbus.proto.messages import Chi2, Estimate, Graph
from factorbus.proto.problems import BadMessage
from factorbus.proto.repair_codec import decode_repaired, encode_ask_repair
from factorbus.proto.symbols import parse_symbol

T = TypeVar("T")


class Questions:
    """What one map can be asked.  The futures get the answer, Refused, or Unavailable after `timeout_s`."""

    def __init__(self, courier: Courier, map_name: str, timeout_s: float) -> None:
        self._courier, self._map, self._timeout_s = courier, map_name, timeout_s

    def estimate(self, of: Sequence[Key] | None, timeout_s: float | None) -> Future[Estimate]:
        """Values at one revision: all, or of some variables."""
        numbers = None if of is None else np.array([parse_symbol(k) if isinstance(k, str) else k for k in of], np.int64)
        return self._ask("estimate", codec.encode_keys_asked(numbers), codec.decode_estimate, timeout_s)

    def chi2(self, batch: bool, timeout_s: float | None, values: bool = False) -> Future[Chi2]:
        """Σ rᵀΩr; with `batch` also of the optimum from scratch, for which a worker gets `timeout_s`; or all of it."""
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        question = {"batch": batch, "timeout_s": timeout_s} | ({"values": True} if values else {})
        return self._ask("chi2", codec.encode_map(question), codec.decode_chi2, timeout_s)

    def graph(self, timeout_s: float | None) -> Future[Graph]:
        """Variables with present values, and factors."""
        return self._ask("graph", codec.encode_map({}), codec.decode_graph, timeout_s)

    def stats(self, timeout_s: float | None) -> Future[dict[str, Any]]:
        """What the service counts and times about the map."""
        return self._ask("stats", codec.encode_map({}), codec.decode_map, timeout_s)

    def export(self, format: str, timeout_s: float | None) -> Future[str]:
        """The map as the text of a file."""
        return self._ask("export", codec.encode_map({"format": format}), _text, timeout_s)

    def repair(self, factors: Sequence[int] | None, probability: float, timeout_s: float | None) -> Future[Repaired]:
        """Which factors are false, and the estimate without them."""
        chosen = None if factors is None else np.array(factors, np.int64)
        question = encode_ask_repair(AskRepair(chosen, probability, values=True))
        return self._ask("repair", question, decode_repaired, timeout_s)

    def _ask(self, question: str, payload: bytes, decode: Callable[[bytes], T], timeout_s: float | None) -> Future[T]:
        what = f"map {self._map!r}, asked for its {question},"
        key = keys.ask_key(self._map, question)
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        return self._courier.carry(Errand(what, key, payload, decode, timeout_s)).future


def _text(data: bytes) -> str:
    text = codec.decode_map(data).get("text")
    if not isinstance(text, str):
        raise BadMessage("export.text", "missing or not a string", "a string")
    return text
