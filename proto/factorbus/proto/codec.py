"""Messages to bytes and back: MessagePack maps with string keys, columns as raw little-endian bytes in bin.

Encoders take well-formed messages.  Decoders take anything: they raise BadMessage (UnknownKind, BadLoss and BadOption
are such) or TooLarge and nothing else, allocate no more than a small multiple of what `limits` admits, ignore fields
they do not know, and return arrays that are read-only views into the message.  Whether numbers are finite, an
information matrix is positive definite or a key is known is not judged here: that is the solver's business.
"""

import sys
from collections.abc import Callable, Mapping
from typing import Any, cast

import msgpack
import numpy as np

from factorbus.proto import fields
from factorbus.proto.arrays import I64
from factorbus.proto.change_columns import changes_to_maps, read_changes
from factorbus.proto.columns import factors_to_maps, read_batch, read_values, variables_to_maps
from factorbus.proto.limits import ANSWER_LIMITS, REQUEST_LIMITS, MessageLimits
from factorbus.proto.messages import Accepted, Chi2, Delta, Estimate, Insert, Job, JobDone, MapGraph, Optimum
from factorbus.proto.problems import Refused
from factorbus.proto.report import Report

_INDEX = (0.0, sys.float_info.max)  # what a linearity index may be compared with
_pack = cast(Callable[..., bytes], msgpack.packb)


def encode_insert(message: Insert) -> bytes:
    """The bytes of an insert."""
    batch = message.batch
    content: dict[str, Any] = {
        "sequence": message.sequence,
        "epoch": message.epoch,
        "variables": variables_to_maps(batch.variables),
        "factors": factors_to_maps(batch.factors),
    }
    if message.settle:
        content["settle"] = True
    if message.convert_below:
        content["convert_below"] = message.convert_below
    if message.changes:
        content["changes"] = changes_to_maps(message.changes)
    return _pack(content)


def decode_insert(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> Insert:
    """The insert that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("insert", data, limits)
    return Insert(
        sequence=fields.integer("", content, "sequence", least=1),
        batch=read_batch(content, limits),
        settle=fields.flag("", content, "settle"),
        epoch=fields.integer("", content, "epoch", default=0),
        convert_below=fields.parameter("insert", content, "convert_below", _INDEX, "0 or more, and finite", 0.0),
        changes=read_changes(content) if "changes" in content else (),
    )


def encode_accepted(message: Accepted) -> bytes:
    """The bytes of the answer to an insert."""
    return _pack(
        {
            "sequence": message.sequence,
            "epoch": message.epoch,
            "revision": message.revision,
            "first_factor": message.first_factor,
            "applied": message.applied,
            "report": message.report,
        }
    )


def report_encoder() -> Callable[[Mapping[str, Any]], bytes]:
    """What gives the bytes of a report as it stands in the answer to an insert and in a delta.  For one thread."""
    return msgpack.Packer().pack


def decode_accepted(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Accepted:
    """The answer to an insert that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("accepted", data, limits)
    return Accepted(
        sequence=fields.integer("", content, "sequence"),
        epoch=fields.integer("", content, "epoch"),
        revision=fields.integer("", content, "revision"),
        first_factor=fields.integer("", content, "first_factor"),
        applied=fields.integer("", content, "applied"),
        report=Report(fields.mapping("", content, "report")),
    )


def encode_estimate(message: Estimate) -> bytes:
    """The bytes of an estimate."""
    return _pack(
        {
            "epoch": message.epoch,
            "revision": message.revision,
            "variables": variables_to_maps(message.variables),
        }
    )


def decode_estimate(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Estimate:
    """The estimate that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("estimate", data, limits)
    return Estimate(
        epoch=fields.integer("", content, "epoch"),
        revision=fields.integer("", content, "revision"),
        variables=read_values(content),
    )


def encode_delta(message: Delta) -> bytes:
    """The bytes of a delta."""
    return _pack(
        {
            "epoch": message.epoch,
            "revision": message.revision,
            "previous": message.previous,
            "variables": variables_to_maps(message.variables),
            "report": message.report,
        }
    )


def decode_delta(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Delta:
    """The delta that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("delta", data, limits)
    return Delta(
        epoch=fields.integer("", content, "epoch"),
        revision=fields.integer("", content, "revision"),
        previous=fields.integer("", content, "previous"),
        variables=read_values(content),
        report=Report(fields.mapping("", content, "report")),
    )


def encode_graph(message: MapGraph) -> bytes:
    """The bytes of a whole graph."""
    return _pack(
        {
            "epoch": message.epoch,
            "revision": message.revision,
            "variables": variables_to_maps(message.batch.variables),
            "factors": factors_to_maps(message.batch.factors),
        }
    )


def decode_graph(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> MapGraph:
    """The graph that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("graph", data, limits)
    return MapGraph(
        epoch=fields.integer("", content, "epoch"),
        revision=fields.integer("", content, "revision"),
        batch=read_batch(content, limits),
    )


def encode_chi2(message: Chi2) -> bytes:
    """The bytes of the answer to ask/chi2."""
    content: dict[str, Any] = {"epoch": message.epoch, "revision": message.revision, "chi2": message.chi2}
    if message.batch is not None:
        content |= {"batch": message.batch, "worker": message.worker, "seconds": message.seconds}
    if message.start:
        content["start"] = message.start
    if not message.batch_converged:
        content["batch_converged"] = False
    if message.notice is not None:
        content["notice"] = _problem_map(message.notice)
    if message.variables:
        content["variables"] = variables_to_maps(message.variables)
    return _pack(content, default=_plain)


def decode_chi2(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Chi2:
    """The answer to ask/chi2 that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("chi2", data, limits)
    asked = content.get("batch") is not None
    return Chi2(
        epoch=fields.integer("", content, "epoch"),
        revision=fields.integer("", content, "revision"),
        chi2=fields.number("", content, "chi2"),
        batch=fields.number("", content, "batch") if asked else None,
        worker=fields.text("", content, "worker", default=""),
        seconds=fields.number("", content, "seconds") if "seconds" in content else 0.0,
        start=fields.text("", content, "start", default=""),
        notice=_read_problem("notice", fields.mapping("", content, "notice")) if content.get("notice") else None,
        variables=read_values(content) if content.get("variables") else (),
        batch_converged=fields.flag("", content, "batch_converged", default=True),
    )


def encode_job(message: Job) -> bytes:
    """The bytes of a job for a worker."""
    return _pack({"job": message.job, "kind": message.kind, "payload": message.payload})


def decode_job(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Job:
    """The job that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("job", data, limits)
    return Job(
        job=fields.text("", content, "job"),
        kind=fields.text("", content, "kind"),
        payload=fields.binary("", content, "payload"),
    )


def encode_job_done(message: JobDone) -> bytes:
    """The bytes of a worker's answer."""
    return _pack({"job": message.job, "kind": message.kind, "payload": message.payload, "seconds": message.seconds})


def decode_job_done(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> JobDone:
    """The worker's answer that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("job_done", data, limits)
    return JobDone(
        job=fields.text("", content, "job"),
        kind=fields.text("", content, "kind"),
        payload=fields.binary("", content, "payload"),
        seconds=fields.number("", content, "seconds"),
    )


def encode_optimum(message: Optimum) -> bytes:
    """The bytes of the result of a job of kind `batch`."""
    content: dict[str, Any] = {
        "chi2": message.chi2,
        "iterations": message.iterations,
        "variables": variables_to_maps(message.variables),
    }
    if message.start:
        content["start"] = message.start
    if not message.converged:
        content["converged"] = False
    return _pack(content)


def decode_optimum(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Optimum:
    """The result of a job of kind `batch` that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("optimum", data, limits)
    return Optimum(
        chi2=fields.number("", content, "chi2"),
        iterations=fields.integer("", content, "iterations"),
        variables=read_values(content),
        start=fields.text("", content, "start", default=""),
        converged=fields.flag("", content, "converged", default=True),
    )


def encode_problem(problem: Any, following: int | None = None) -> bytes:
    """The bytes of anything with `code`, `message` and `detail`: a Problem or an error of the solver.

    following: of a refused insert, `detail.next` unless the problem has one already.
    """
    content = _problem_map(problem)
    if following is not None:
        content["detail"].setdefault("next", following)
    return _pack(content, default=_plain)


def decode_problem(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Refused:
    """The problem that `data` is, ready to be raised.  Raises BadMessage, TooLarge."""
    return _read_problem("", fields.read_map("problem", data, limits))


def encode_keys_asked(keys: I64 | None) -> bytes:
    """The bytes of the question ask/estimate: for `keys` (n,), or for everything."""
    return _pack({} if keys is None else {"keys": np.asarray(keys, fields.I8).tobytes()})


def decode_keys_asked(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> I64 | None:
    """The keys (n,) that ask/estimate is about, None for all.  Raises BadMessage, TooLarge."""
    content = decode_map(data, limits, what="question")
    return fields.keys(lambda: "question", content, 0) if content.get("keys") is not None else None


def encode_map(content: Mapping[str, Any]) -> bytes:
    """The bytes of a plain map: questions, rows of admin/maps, stats, events."""
    return _pack(dict(content), default=_plain)


def decode_map(data: bytes, limits: MessageLimits = ANSWER_LIMITS, what: str = "map") -> dict[str, Any]:
    """The plain map that `data` is; no bytes at all are an empty map.  Raises BadMessage, TooLarge."""
    return dict(fields.read_map(what, data, limits)) if data else {}


def _problem_map(problem: Any) -> dict[str, Any]:
    detail = {str(name): value for name, value in dict(problem.detail).items()}
    return {"code": problem.code, "message": problem.message, "detail": detail}


def _read_problem(where: str, content: Mapping[str, Any]) -> Refused:
    code, message = fields.text(where, content, "code"), fields.text(where, content, "message")
    return Refused(code, message, fields.mapping(where, content, "detail"))


def _plain(value: Any) -> Any:
    """What MessagePack has no type for, as what it has: a NumPy scalar as its number, anything else as its text."""
    number = value.item() if isinstance(value, np.generic) else None
    return number if isinstance(number, (bool, int, float)) else str(value)
