"""What a map's core makes of closures that are tested: an event where one's state changes, and verdicts that are no
client's inserts."""

from collections.abc import Sequence

from factorbus.proto import codec
from factorbus.proto.own_clients import OWN_CLIENTS
from factorbus.service.core.events import Effect, MovedClosure, Outcome, Publish, Verdict


def asked_outcomes(verdict: Verdict) -> list[Outcome]:
    """Those of inserts that clients sent."""
    return [outcome for outcome in verdict.outcomes if outcome.insert.client not in OWN_CLIENTS]


def closures_moved(moved: Sequence[MovedClosure], epoch: int, revision: int) -> list[Effect]:
    """The event `closures`, if the state of any is another."""
    if not moved:
        return []
    told = {
        "event": "closures",
        "epoch": epoch,
        "revision": revision,
        "factors": [each.factor for each in moved],
        "states": [each.state for each in moved],
        "reasons": [each.reason for each in moved],
    }
    return [Publish("event", codec.encode_map(told))]
