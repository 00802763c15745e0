"""What may be asked of a map, and the answers, made from a snapshot of one revision.

A snapshot is taken on the solver's thread between two steps and is a copy: making and sending the answer is
somebody else's time, and no reader sees half a step or holds one up.
"""

import io
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorbus.proto import codec
from factorbus.proto.arrays import I64
from factorbus.proto.keys import QUESTIONS
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Chi2, Estimate, Factors, Graph, Variables
from factorbus.proto.problems import BadMessage, Problem, UnknownQuestion
from factorbus.proto.symbols import format_symbol

_FORMATS = ("g2o", "tum")


class NotInMap(Problem):
    """A question about a variable that the map does not have."""

    code = "unknown_variable"

    def __init__(self, keys: Iterable[int]) -> None:
        names = [format_symbol(int(key)) for key in keys]
        shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
        super().__init__(f"the map has no {shown}; ask without keys for all there are", keys=names[:100])


@dataclass(frozen=True, slots=True)
class Question:
    """One question, checked.  keys: of an estimate, None for all.  batch, timeout_s: of chi2.  format: of export."""

    name: str
    keys: I64 | None = None
    batch: bool = False
    timeout_s: float = 60.0
    format: str = "g2o"


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Copies of what some questions need, all of one revision."""

    epoch: int
    revision: int
    variables: tuple[Variables, ...] = ()
    factors: tuple[Factors, ...] = ()
    chi2: float = 0.0

    @property
    def graph(self) -> Graph:
        """The whole map, if the snapshot was taken for a question that needs it."""
        return Graph(self.epoch, self.revision, Batch(self.variables, self.factors))


def parse(name: str, payload: bytes) -> Question:
    """The question `name` with the parameters in `payload`.  Raises UnknownQuestion, BadMessage, TooLarge."""
    if name == "estimate":
        return Question(name, keys=codec.decode_keys_asked(payload))
    if name not in QUESTIONS:
        raise UnknownQuestion(name, f"one of {', '.join(QUESTIONS)}")
    content = codec.decode_map(payload, REQUEST_LIMITS, what="question")
    if name == "chi2":
        return Question(name, batch=_flag(content, "batch"), timeout_s=_seconds(content, "timeout_s", 60.0))
    if name == "export" and content.get("format", "g2o") not in _FORMATS:
        raise UnknownQuestion("export", f"a format of {', '.join(_FORMATS)}, not {content['format']!r:.40}")
    return Question(name, format=content.get("format", "g2o"))


def snapshot(solver: Any, epoch: int, revision: int, questions: Iterable[Question]) -> Snapshot:
    """What `questions` need of `solver`, copied."""
    names = {question.name for question in questions}
    whole = bool(names & {"graph", "export"}) or any(q.batch for q in questions)
    variables, factors = solver.graph() if whole else ((), ())
    if not whole and names & {"estimate", "keyframe"}:
        variables = solver.estimate()
    chi2 = solver.chi2() if "chi2" in names else 0.0
    return Snapshot(epoch, revision, as_variables(variables), as_factors(factors), chi2)


def as_variables(groups: Iterable[Any]) -> tuple[Variables, ...]:
    """The solver's groups as what the codec takes."""
    return tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in groups)


def as_factors(groups: Iterable[Any]) -> tuple[Factors, ...]:
    """The solver's factor groups as what the codec takes."""
    return tuple(Factors(g.kind, g.keys, g.measured, g.information) for g in groups)


def answer(question: Question, taken: Snapshot) -> bytes:
    """The answer to any question but stats and chi2 against batch.  Raises NotInMap."""
    if question.name in ("estimate", "keyframe"):
        chosen = taken.variables if question.keys is None else _chosen(taken.variables, question.keys)
        return codec.encode_estimate(Estimate(taken.epoch, taken.revision, chosen))
    if question.name == "chi2":
        return codec.encode_chi2(Chi2(taken.epoch, taken.revision, taken.chi2))
    if question.name == "graph":
        return codec.encode_graph(taken.graph)
    return codec.encode_map(
        {
            "epoch": taken.epoch,
            "revision": taken.revision,
            "format": question.format,
            "text": _text(question.format, taken.graph.batch),
        }
    )


def _chosen(groups: Iterable[Variables], keys: I64) -> tuple[Variables, ...]:
    missing = np.unique(keys)
    chosen: list[Variables] = []
    for group in groups:
        rows = np.isin(group.keys, keys)
        if rows.any() and group.values is not None:
            chosen.append(Variables(group.kind, group.keys[rows], group.values[rows], group.fixed))
            missing = np.setdiff1d(missing, group.keys[rows])
    if missing.size:
        raise NotInMap(missing)
    return tuple(chosen)


def _text(kind: str, batch: Batch) -> str:
    from factorbus.formats import write_g2o, write_tum  # only who asks for an export pays for it

    text = io.StringIO()
    (write_g2o if kind == "g2o" else write_tum)(text, batch)
    return text.getvalue()


def _flag(content: dict[str, Any], name: str) -> bool:
    value = content.get(name, False)
    if type(value) is not bool:
        raise BadMessage(f"question.{name}", f"is {value!r:.40}", "true or false")
    return value


def _seconds(content: dict[str, Any], name: str, default: float) -> float:
    value = content.get(name, default)
    if type(value) not in (int, float) or not 0 < value <= 86_400:
        raise BadMessage(f"question.{name}", f"is {value!r:.40}", "seconds, more than 0 and at most a day")
    return float(value)
