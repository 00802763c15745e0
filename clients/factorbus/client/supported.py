"""What an older service would skip without a word: it is not sent, which is said."""

from collections.abc import Mapping
from typing import Any

from factorbus.proto.messages import Batch, Change
from factorbus.proto.problems import NotSupported


def check_changes(protocol: Mapping[str, Any], listed: tuple[Change, ...]) -> None:
    """Raises NotSupported for what a service with this protocol would skip, or not know."""
    if protocol and listed:
        told = protocol.get("changes") if "changes" in protocol.get("insert", ()) else ()
        names = told if isinstance(told, list | tuple) else ()
        for change in listed:
            if change.change not in names:
                raise NotSupported(f"the change {change.change!r}", str(protocol.get("product", "")))


def check_batch(protocol: Mapping[str, Any], batch: Batch) -> None:
    """Raises NotSupported for fields of variables and factors that a service with this protocol would skip."""
    check_stamps(protocol, batch)
    check_trusted(protocol, batch)


def check_stamps(protocol: Mapping[str, Any], batch: Batch) -> None:
    """Raises NotSupported where a service with this protocol would skip them."""
    skipped = bool(protocol) and "stamps" not in protocol.get("variable_fields", ())
    if skipped and any(group.stamps is not None for group in batch.variables):
        raise NotSupported("time stamps of variables", str(protocol.get("product", "")))


def check_trusted(protocol: Mapping[str, Any], batch: Batch) -> None:
    """Raises NotSupported where a service with this protocol would skip it."""
    skipped = bool(protocol) and "trusted" not in protocol.get("factor_fields", ())
    if skipped and any(group.trusted for group in batch.factors):
        raise NotSupported("trusted factors", str(protocol.get("product", "")))


def check_suspects(protocol: Mapping[str, Any]) -> None:
    """Raises NotSupported where a service with this protocol does not test loop closures."""
    if protocol and "suspects" not in protocol.get("questions", ()):
        raise NotSupported("a map that tests its loop closures", str(protocol.get("product", "")))


def check_components(protocol: Mapping[str, Any]) -> None:
    """Raises NotSupported where a service with this protocol does not tell them."""
    if protocol and "components" not in protocol.get("questions", ()):
        raise NotSupported("which parts of a map nothing joins", str(protocol.get("product", "")))


def check_interest(protocol: Mapping[str, Any]) -> None:
    """Raises NotSupported where a service with this protocol knows of no interests."""
    if protocol and "interest" not in protocol.get("questions", ()):
        raise NotSupported("an interest in a part of a map", str(protocol.get("product", "")))
