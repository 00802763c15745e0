"""What of wire version 1 this package knows: a service says it, so that a newer client does not send in vain."""

from typing import Any

from factorbus.proto.keys import QUESTIONS
from factorbus.proto.kinds import CHANGES, FACTOR_KINDS, LOSSES, VARIABLE_KINDS
from factorbus.proto.version import __version__

# The fields of an insert: a reader skips those that it does not know.
INSERT_FIELDS = ("sequence", "epoch", "settle", "convert_below", "changes", "variables", "factors")
# Those of a group of variables in it, likewise.
VARIABLE_FIELDS = ("kind", "keys", "values", "fixed", "stamps")
# Those of a group of factors in it, likewise.
FACTOR_FIELDS = ("kind", "keys", "measured", "information", "loss", "scale", "trusted")


def known() -> dict[str, Any]:
    """For the field `protocol` of what a service says of itself: names, by what they are names of."""
    return {
        "version": 1,
        "product": __version__,
        "insert": list(INSERT_FIELDS),
        "variable_fields": list(VARIABLE_FIELDS),
        "factor_fields": list(FACTOR_FIELDS),
        "variables": list(VARIABLE_KINDS),
        "factors": list(FACTOR_KINDS),
        "losses": list(LOSSES),
        "changes": list(CHANGES),
        "questions": list(QUESTIONS),
    }
