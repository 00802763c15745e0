"""Names on the bus as rmw_zenoh gives them: keys of topics, liveliness tokens, qualities of service, attachments.

Its `docs/design.md` describes keys and tokens, its sources the rest.  Pure: strings and bytes.
"""

import re
import struct
from dataclasses import dataclass

import xxhash

from factorbus.ros2.problems import BadRosName

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
# Sequence number and time of the source in nanoseconds, then the 16 bytes of the gid behind their count.
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic: its full name ("/robot1/odom"), its type ("nav_msgs/msg/Odometry") and the hash of that, its depth."""

    name: str
    type: str
    hash: str
    depth: int = 10

    def __post_init__(self) -> None:
        if not _TOPIC.fullmatch(self.name):
            raise BadRosName("the topic", self.name, "a full ROS name, such as /robot1/odom")

    def key(self, domain: int) -> str:
        """Where its messages are published: domain, name, type and hash."""
        return f"{domain}/{self.name.strip('/')}/{dds_type(self.type)}/{self.hash}"


@dataclass(frozen=True, slots=True)
class NodeName:
    """A node: the session it lives in, its domain, namespace ("/" or "/robot1") and name."""

    session: str
    domain: int
    namespace: str
    name: str

    def token(self) -> str:
        """Alive while the node is: what `ros2 node list` goes by."""
        return self._place(0, "NN")

    def endpoint_token(self, number: int, kind: str, topic: Topic, kept: bool = False) -> str:
        """Alive while the endpoint is: what `ros2 topic list` goes by.  kind: MP publishes, MS subscribes, SS serves.

        kept: with what was published before (transient local).
        """
        words = (_mangled(topic.name), dds_type(topic.type), topic.hash, quality(topic.depth, kept))
        return "/".join((self._place(number, kind), *words))

    @property
    def full_name(self) -> str:
        """As ROS has it, what stands for `~`: /robot1/factorbus."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    def _place(self, number: int, kind: str) -> str:
        enclave = "%"  # none
        return (
            f"@ros2_lv/{self.domain}/{self.session}/0/{number}/{kind}/{enclave}/{_mangled(self.namespace)}/{self.name}"
        )


def dds_type(type_name: str) -> str:
    """A type as it stands in keys: nav_msgs::msg::dds_::Odometry_ for nav_msgs/msg/Odometry."""
    package, folder, name = type_name.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def quality(depth: int, kept: bool = False) -> str:
    """Reliable, volatile, or transient local where `kept`, the last `depth`: what is as by default is left out."""
    return f":{1 if kept else ''}:,{depth}:,:,:,,"


def gid(token: str) -> bytes:
    """The 16 bytes that name an endpoint: XXH3 (128 bits) of its token, low half first."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(_GID_BYTES, "little")


def attachment(sequence: int, stamp_ns: int, of: bytes) -> bytes:
    """What goes with every message: which of this endpoint it is, from 1 on, when it was sent, whose it is."""
    return _ATTACHMENT.pack(sequence, stamp_ns, _GID_BYTES, of)


def read_attachment(data: bytes) -> tuple[int, bytes]:
    """(number, gid) of one; zeros of what is none, as of a caller that is no ROS node."""
    if len(data) != _ATTACHMENT.size:
        return 0, bytes(_GID_BYTES)
    number, _, _, of = _ATTACHMENT.unpack(data)
    return number, of


def _mangled(name: str) -> str:
    return name.replace("/", "%")
