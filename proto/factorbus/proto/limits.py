"""How large a message may be, judged before anything is allocated for it."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MessageLimits:
    """What a decoder takes.

    max_bytes: of the whole message.  max_variables, max_factors: of the batch in it.  max_elements: of one
    MessagePack array or map.  max_containers: MessagePack arrays and maps in all; an empty one is a byte on the
    wire and some 60 in memory, so that without this limit 64 MiB of message could ask for 4 GiB.
    """

    max_bytes: int
    max_variables: int
    max_factors: int
    max_elements: int = 256
    max_containers: int = 4096


# What a service takes from strangers, and what a client takes from the service it chose to connect to.
REQUEST_LIMITS = MessageLimits(max_bytes=64 << 20, max_variables=1_000_000, max_factors=1_000_000)
ANSWER_LIMITS = MessageLimits(
    max_bytes=256 << 20, max_variables=1 << 30, max_factors=1 << 30, max_elements=65_536, max_containers=65_536
)
