"""Which parts of a map nothing joins, and what holds each: the answer to ask/components, both ways, as bytes.

Readers raise BadMessage, TooLarge.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from factorbus.proto import fields
from factorbus.proto.codec import encode_map
from factorbus.proto.fields import Map
from factorbus.proto.limits import ANSWER_LIMITS, MessageLimits

COMPONENTS_LISTED = 1000  # the largest of them


@dataclass(frozen=True, slots=True)
class Component:
    """Variables that chains of factors join, and no factor to any other.

    first: the least of their keys.  letters: how many variables have each letter, "" where keys have none.  held: what
    says where it is in the map's frame, how many of each kind: "fixed" variables, and factors such as priors.
    own_frame: that is no more than one fixed pose or one prior of a pose, so how it lies to others is not known.
    """

    first: int
    variables: int
    factors: int
    letters: Mapping[str, int]
    held: Mapping[str, int]
    own_frame: bool


@dataclass(frozen=True, slots=True)
class Components:
    """Those of a map at one revision.

    count: how many there are.  listed: the largest first, 1000 at most.  in_no_frame: variables that are in none of
    them, as they are the same in every frame: mounts, and plain numbers such as a bias.
    """

    epoch: int
    revision: int
    count: int = 0
    listed: tuple[Component, ...] = ()
    in_no_frame: int = 0


def encode_components(message: Components) -> bytes:
    """The bytes of the answer."""
    return encode_map(
        {
            "epoch": message.epoch,
            "revision": message.revision,
            "count": message.count,
            "in_no_frame": message.in_no_frame,
            "components": [
                {
                    "first": each.first,
                    "variables": each.variables,
                    "factors": each.factors,
                    "letters": dict(each.letters),
                    "held": dict(each.held),
                    "own_frame": each.own_frame,
                }
                for each in message.listed
            ],
        }
    )


def decode_components(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Components:
    """The answer that `data` is."""
    content = fields.read_map("components", data, limits)
    return Components(
        fields.integer("", content, "epoch"),
        fields.integer("", content, "revision"),
        fields.integer("", content, "count"),
        tuple(_component(each) for each in fields.maps("", content, "components")),
        fields.integer("", content, "in_no_frame"),
    )


def _component(content: Map) -> Component:
    where = "components"
    return Component(
        fields.integer(where, content, "first", least=-(1 << 63)),
        fields.integer(where, content, "variables"),
        fields.integer(where, content, "factors"),
        _counts(content, "letters"),
        _counts(content, "held"),
        fields.flag(where, content, "own_frame"),
    )


def _counts(content: Map, name: str) -> dict[str, int]:
    found = fields.mapping("components", content, name)
    return {str(each): fields.integer(name, found, each) for each in found}
