"""What a map can be asked about its uncertainty: how sure it is of what, and what it thinks of a measurement.

    with connect("tcp/127.0.0.1:7447", client="robot1") as bus, bus.map("hall") as hall:
        hall.uncertainty.covariance(["x10"])["x10"]                      # 3 x 3, in the robot's own frame
        hall.uncertainty.gate(Draft().between_se2("x3", "x40", (0, 0, 0), sigmas=(0.1, 0.1, 0.02))).plausible

Covariances are in tangent spaces: of local increments, translation first, metres and radians.  No compiler and no scipy
is needed here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import all_finite, as_numbers, checked_probability, checked_seconds, of_type
from factorbus.client.call_order import call_order, reading_columns
from factorbus.client.draft import Draft
from factorbus.client.key_numbers import Key, as_list, id_numbers, key_number, key_numbers
from factorbus.client.request_sender import Request, RequestSender
from factorbus.proto import asking_codec, keys
from factorbus.proto.arrays import F64
from factorbus.proto.asking import (
    AskAssociate,
    AskCovariance,
    AskGain,
    AskGate,
    AskWhy,
    Associated,
    Covariances,
    Gained,
    Gated,
    Why,
)
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors
from factorbus.proto.problems import BadMessage, BadShape
from factorbus.wording import counted

T = TypeVar("T")
Candidates: TypeAlias = Batch | Draft | Sequence[Factors]


class UncertaintyQuestions:
    """Each method sends a question and returns the future of its answer, Refused, or Unavailable after `timeout_s`."""

    def __init__(self, sender: RequestSender, map_name: str, timeout_s: float) -> None:
        self._sender, self._map, self._timeout_s = sender, map_name, timeout_s

    def covariance(
        self, blocks: str, of: Sequence[Key] | Key | None, others: Sequence[Key] | Key | None, timeout_s: float | None
    ) -> Future[Covariances]:
        """Blocks of the covariance, as in `AskCovariance`."""
        ask = AskCovariance(
            blocks, None if of is None else key_numbers(of), None if others is None else key_numbers(others)
        )
        return self._ask(
            "covariance", asking_codec.encode_ask_covariance(ask), asking_codec.decode_covariances, timeout_s
        )

    def gate(self, candidates: Candidates, probability: float, timeout_s: float | None) -> Future[Gated]:
        """Which candidates are plausible."""
        ask = AskGate(factors_of(candidates), checked_probability("probability", probability))
        columns = "distance", "dims", "threshold", "plausible"
        read = reading_columns(asking_codec.decode_gated, columns, call_order(candidates))
        return self._ask("gate", asking_codec.encode_ask_gate(ask), read, timeout_s)

    def gain(self, candidates: Candidates, timeout_s: float | None) -> Future[Gained]:
        """What candidates would tell."""
        question = asking_codec.encode_ask_gain(AskGain(factors_of(candidates)))
        read = reading_columns(asking_codec.decode_gained, ("gain",), call_order(candidates))
        return self._ask("gain", question, read, timeout_s)

    def associate(self, ask: AskAssociate, timeout_s: float | None) -> Future[Associated]:
        """Which landmark is which."""
        question = asking_codec.encode_ask_associate(ask)
        return self._ask("associate", question, asking_codec.decode_associated, timeout_s)

    def why(self, ask: AskWhy, timeout_s: float | None) -> Future[Why]:
        """What holds a variable or a factor."""
        return self._ask("why", asking_codec.encode_ask_why(ask), asking_codec.decode_why, timeout_s)

    def _ask(self, question: str, payload: bytes, decode: Callable[[bytes], T], timeout_s: float | None) -> Future[T]:
        what = f"map {self._map!r}, asked for its {question},"
        key = keys.ask_key(self._map, question)
        timeout_s = checked_seconds("timeout_s", timeout_s, self._timeout_s)
        return self._sender.carry(Request(what, key, payload, decode, timeout_s)).future


class Uncertainty:
    """The same, waiting for the answers.  All raise Refused and Unavailable; every answer names its revision."""

    def __init__(self, ask: UncertaintyQuestions) -> None:
        self.ask = ask

    def covariance(
        self, of: Sequence[Key] | Key | None = None, *more: Key, timeout_s: float | None = None
    ) -> Covariances:
        """The covariance of each of some variables, or of all of them: `answer[symbol("x", 3)]` is one block."""
        return self.ask.covariance("diagonal", as_list("covariance", of, more), None, timeout_s).result()

    def last(self, timeout_s: float | None = None) -> Covariances:
        """The covariance of the pose that was inserted last: microseconds of the solver's time."""
        return self.ask.covariance("last", None, None, timeout_s).result()

    def joint(self, of: Sequence[Key] | Key, *more: Key, timeout_s: float | None = None) -> F64:
        """The joint covariance (d, d) of some variables, their tangent spaces one after the other."""
        return matrix_of(self.ask.covariance("joint", as_list("joint", of, more), None, timeout_s).result())

    def cross(self, rows: Sequence[Key] | Key, columns: Sequence[Key] | Key, *, timeout_s: float | None = None) -> F64:
        """The covariance (d, e) between some variables and others."""
        return matrix_of(self.ask.covariance("cross", rows, columns, timeout_s).result())

    def relative(
        self, pairs: Sequence[tuple[Key, Key]] | tuple[Key, Key], *more: Any, timeout_s: float | None = None
    ) -> Covariances:
        """Of each pair, the second as seen from the first: its value and its covariance there."""
        return self.ask.covariance("relative", paired(as_list("relative", pairs, more)), None, timeout_s).result()

    def gate(
        self,
        candidates: Candidates,
        probability: float = 0.95,
        *,
        timeout_s: float | None = None,
    ) -> Gated:
        """Which of the candidate factors are plausible, at a gate that a right one passes with `probability`.

        Answers are in the order of the candidates, of a draft in that of the calls.
        """
        return self.ask.gate(candidates, probability, timeout_s).result()

    def gain(self, candidates: Candidates, *, timeout_s: float | None = None) -> Gained:
        """How many nats of information each candidate factor, in the order of the candidates, would bring by itself."""
        return self.ask.gain(candidates, timeout_s).result()

    def associate(
        self,
        pose: Key,
        kind: str,
        measured: ArrayLike,
        *,
        information: ArrayLike,
        landmarks: Sequence[Key] | Key | None = None,
        probability: float = 0.95,
        timeout_s: float | None = None,
    ) -> Associated:
        """Which landmark each observation from `pose` is of, jointly.

        kind: "landmark_se2", "landmark_se3" or "bearing_range_se2".  measured (n, size).  information: as in a draft, a
        matrix or its upper triangle, for all of them, or a row for each.  landmarks: to choose from; None: all there
        are.  Raises BadShape.
        """
        ask = association_question(pose, kind, measured, information, landmarks, probability)
        return self.ask.associate(ask, timeout_s).result()

    def why(self, key: Key | None = None, *, factor: int | None = None, timeout_s: float | None = None) -> Why:
        """What holds a variable, or what a factor (by its id) does, and what the map's last step did and why."""
        return self.ask.why(why_question(key, factor), timeout_s).result()


def paired(pairs: Sequence[tuple[Key, Key]] | tuple[Key, Key]) -> list[Key]:
    """Pairs one after the other; one pair will do.  Raises BadShape."""
    if isinstance(pairs, str) or not isinstance(pairs, (Sequence, np.ndarray)):
        raise BadShape("pairs", repr(pairs)[:80], 'pairs of keys, such as [("x1", "x2")]')
    alone = len(pairs) == 2 and not any(isinstance(key, (tuple, list, np.ndarray)) for key in pairs)
    each: list[Any] = [pairs] if alone else list(pairs)
    if any(isinstance(pair, str) or not isinstance(pair, (Sequence, np.ndarray)) or len(pair) != 2 for pair in each):
        raise BadShape("pairs", repr(pairs)[:80], 'pairs of keys, such as [("x1", "x2")]')
    return [key for pair in each for key in pair]


def factors_of(candidates: Candidates) -> tuple[Factors, ...]:
    """The factors of a draft or a batch.  Raises BadShape when there are variables in it, BadOption."""
    if isinstance(candidates, Draft):
        candidates = candidates.batch()
    if not isinstance(candidates, Batch):
        wanted = "a Draft, a Batch, or a sequence of Factors"
        listed = of_type("candidates", candidates, Sequence, wanted)
        return tuple(of_type("candidates", each, Factors, wanted) for each in listed)
    if candidates.variable_count:
        raise BadShape("candidates", f"{counted(candidates.variable_count, 'variable')} among them", "factors only")
    return candidates.factors


def matrix_of(answer: Covariances) -> F64:
    """The matrix of a joint or cross answer."""
    if answer.covariance is None:
        raise BadMessage("covariance", f"an answer without a matrix, of blocks {answer.blocks!r}", "one matrix")
    return answer.covariance


def why_question(key: Key | None, factor: int | None) -> AskWhy:
    """The question.  Raises BadShape unless one of them is given."""
    if (key is None) == (factor is None):
        raise BadShape("why", "both or neither of a key and a factor", "one of them")
    ids = None if factor is None else id_numbers("why", factor)
    if ids is not None and ids.size != 1:
        raise BadShape("why", counted(ids.size, "factor"), "one factor")
    return AskWhy(None if key is None else key_number(key), None if ids is None else int(ids[0]))


def association_question(
    pose: Key,
    kind: str,
    measured: ArrayLike,
    information: ArrayLike,
    landmarks: Sequence[Key] | Key | None,
    probability: float,
) -> AskAssociate:
    """The question, with the information of every observation.  Raises BadShape."""
    known = FACTOR_KINDS.get(kind) if isinstance(kind, str) else None
    if known is None:
        raise BadShape("kind", repr(kind), "landmark_se2, landmark_se3 or bearing_range_se2")
    rows = np.atleast_2d(all_finite("measured", as_numbers("measured", measured)))
    if rows.shape[1] != known.size:
        raise BadShape("measured", " × ".join(map(str, rows.shape)), f"n × {known.size}")
    weights = as_numbers("information", information)
    if weights.shape == (known.dim, known.dim):
        weights = weights[np.triu_indices(known.dim)]
    if weights.shape not in ((known.information_size,), (len(rows), known.information_size)):
        raise BadShape("information", " × ".join(map(str, weights.shape)), f"{known.dim} × {known.dim}")
    weights = np.broadcast_to(weights, (len(rows), known.information_size))
    chosen = None if landmarks is None else key_numbers(landmarks)
    return AskAssociate(key_number(pose), kind, rows, weights, chosen, checked_probability("probability", probability))
