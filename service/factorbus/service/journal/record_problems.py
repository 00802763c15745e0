"""What can be wrong between a replica and its upstream; the codes are stable."""

from factorbus.proto.problems import Problem


class RecordsMovedOn(Problem):
    """Records were to go on from a place that is not where the journal ends."""

    code = "records_moved_on"

    def __init__(self, name: str, record: int, wanted: int) -> None:
        super().__init__(
            f"the journal of map {name!r} ends at record {record}, and what was sent goes on from another place "
            f"({wanted}): ask for what came between (ask/records), put it before yours, and send again",
            record=record,
        )


class OtherRecords(Problem):
    """The journal does not have what the asker goes on from."""

    code = "other_records"

    def __init__(self, name: str, record: int, wanted: int) -> None:
        super().__init__(
            f"the journal of map {name!r}, which ends at record {record}, has something else at record {wanted} than "
            "the asker was told: ask for all of it, from record 0",
            record=record,
        )


class RecordsDiffer(Problem):
    """An insert that upstream accepted is refused here, or the other way round."""

    code = "records_differ"

    def __init__(self, name: str, client: str, sequence: int, record: int) -> None:
        super().__init__(
            f"insert {sequence} of client {client} in record {record} of map {name!r} came to another end here than "
            "upstream; use the same version of factorbus at both ends",
            client=client,
            sequence=sequence,
        )


class FactorsMoved(Problem):
    """A change names factors whose ids others have now."""

    code = "factors_moved"

    def __init__(self, first: int) -> None:
        super().__init__(
            f"inserts of others came before this one's, so factors from id {first} on have other ids than were "
            "answered; ask for the graph, and send the change with the ids that it has",
            first=first,
        )


class NumberTaken(Problem):
    """Upstream has another insert of this client and number."""

    code = "number_taken"

    def __init__(self, client: str, sequence: int) -> None:
        super().__init__(
            f"upstream has another insert {sequence} of client {client}, which stays; this one is dropped: give every "
            "run of a client a name of its own",
            client=client,
            sequence=sequence,
        )


class NotRecorded(Problem):
    """A map without a journal has no records."""

    code = "no_journal"

    def __init__(self, name: str) -> None:
        super().__init__(
            f"map {name!r} has no journal, so nobody can follow it by its records: start its service with --journal",
            known=(),
        )
