"""std_srvs/srv/Trigger, the one type of service that is used: its definition, for hashes and CDR.

A service is described by three messages (REP 2016): request, response, and an event with both.  An empty message has
one byte that means nothing.
"""

from typing import Any

from rosbags.interfaces import Nodetype

TRIGGER = "std_srvs/srv/Trigger"
REQUEST, RESPONSE, _EVENT = (f"{TRIGGER}_{part}" for part in ("Request", "Response", "Event"))
_INFO = "service_msgs/msg/ServiceEventInfo"


def register_trigger(store: Any) -> None:
    """Add it to a type store.  By hand, for a store reads the definitions of messages, not of services.

    In the hash of a type the `char` of a definition is a uint8, so that one of ServiceEventInfo is written as that.
    """
    byte = _basic("uint8")
    store.fielddefs[_INFO] = (
        [],
        [
            ("event_type", byte),
            ("stamp", _named("builtin_interfaces/msg/Time")),
            ("client_gid", (Nodetype.ARRAY, (byte, 16))),
            ("sequence_number", _basic("int64")),
        ],
    )
    store.register(
        {
            REQUEST: ([], [("structure_needs_at_least_one_member", byte)]),
            RESPONSE: ([], [("success", _basic("bool")), ("message", _basic("string"))]),
            _EVENT: (
                [],
                [("info", _named(_INFO)), ("request", _at_most_one(REQUEST)), ("response", _at_most_one(RESPONSE))],
            ),
            TRIGGER: (
                [],
                [
                    ("request_message", _named(REQUEST)),
                    ("response_message", _named(RESPONSE)),
                    ("event_message", _named(_EVENT)),
                ],
            ),
        }
    )


def _basic(name: str) -> Any:
    return Nodetype.BASE, (name, 0)


def _named(name: str) -> Any:
    return Nodetype.NAME, name


def _at_most_one(name: str) -> Any:
    return Nodetype.SEQUENCE, (_named(name), 1)
