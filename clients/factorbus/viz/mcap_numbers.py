"""Estimates and factors as numbers in a recording: protobuf, whose schema the recording carries.

Keys are those of the wire (a letter's code in the highest byte), rows of `values`, `measured` and `information` lie one
after another, eight bytes a number.
"""

from typing import Any

import foxglove
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from factorbus.proto.messages import Delta, Factors, Variables

_PACKAGE = "factorbus"
_TYPES = descriptor_pb2.FieldDescriptorProto
_SCALARS = {
    "uint64": _TYPES.TYPE_UINT64, "uint32": _TYPES.TYPE_UINT32, "string": _TYPES.TYPE_STRING,
    "fixed64": _TYPES.TYPE_FIXED64, "sfixed64": _TYPES.TYPE_SFIXED64, "double": _TYPES.TYPE_DOUBLE,
}  # fmt: skip
# Message → fields, numbered from 1; [] is a list, a name with a capital another message.
_MESSAGES = {
    "Variables": {
        "kind": "string", "keys": "fixed64[]", "width": "uint32", "values": "double[]", "stamps": "sfixed64[]",
    },
    "Delta": {"epoch": "uint64", "revision": "uint64", "previous": "uint64", "variables": "Variables[]"},
    "Factors": {
        "epoch": "uint64", "revision": "uint64", "kind": "string", "arity": "uint32", "keys": "fixed64[]",
        "measured": "double[]", "information": "double[]",
    },
}  # fmt: skip


class NumberChannels:
    """/map/delta and /map/factors of a recording."""

    def __init__(self, context: foxglove.Context) -> None:
        self._delta = _channel("/map/delta", "Delta", context)
        self._factors = _channel("/map/factors", "Factors", context)

    def write_delta(self, delta: Delta, now_ns: int) -> None:
        """A delta, whole."""
        groups = [_variables(group) for group in delta.variables if group.values is not None]
        message = _CLASSES["Delta"](
            epoch=delta.epoch, revision=delta.revision, previous=delta.previous, variables=groups
        )
        self._delta.log(message.SerializeToString(), log_time=now_ns)

    def write_factors(self, epoch: int, revision: int, group: Factors, now_ns: int) -> None:
        """Factors of one kind."""
        keys = group.keys
        message = _CLASSES["Factors"](
            epoch=epoch, revision=revision, kind=group.kind, arity=keys.shape[1], keys=keys.ravel().tolist(),
            measured=group.measured.ravel().tolist(), information=group.information.ravel().tolist(),
        )  # fmt: skip
        self._factors.log(message.SerializeToString(), log_time=now_ns)


def _variables(group: Variables) -> Any:
    values, stamps = group.values, group.stamps
    if values is None:
        return _CLASSES["Variables"](kind=group.kind)
    return _CLASSES["Variables"](
        kind=group.kind, keys=group.keys.tolist(), width=values.shape[1], values=values.ravel().tolist(),
        stamps=[] if stamps is None else stamps.tolist(),
    )  # fmt: skip


def _declared() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(name="factorbus.proto", package=_PACKAGE, syntax="proto3")
    for name, fields in _MESSAGES.items():
        message = file.message_type.add(name=name)
        for number, (field, kind) in enumerate(fields.items(), start=1):
            many, plain = kind.endswith("[]"), kind.removesuffix("[]")
            told = message.field.add(name=field, number=number)
            told.label = _TYPES.LABEL_REPEATED if many else _TYPES.LABEL_OPTIONAL
            if plain in _SCALARS:
                told.type = _SCALARS[plain]
            else:
                told.type, told.type_name = _TYPES.TYPE_MESSAGE, f".{_PACKAGE}.{plain}"
    return file


_FILE = _declared()
_POOL = descriptor_pool.DescriptorPool()
_POOL.Add(_FILE)
_CLASSES = {
    name: message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"{_PACKAGE}.{name}")) for name in _MESSAGES
}


def _channel(topic: str, name: str, context: foxglove.Context) -> foxglove.Channel:
    whole = descriptor_pb2.FileDescriptorSet(file=[_FILE]).SerializeToString()
    schema = foxglove.Schema(name=f"{_PACKAGE}.{name}", encoding="protobuf", data=whole)
    return foxglove.Channel(topic, schema=schema, message_encoding="protobuf", context=context)
