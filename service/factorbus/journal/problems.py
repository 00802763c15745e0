"""What can be wrong with a journal; the codes are stable and travel on the bus."""

from pathlib import Path

from factorbus.ownership import UnsafeFolder
from factorbus.proto.problems import Problem


class JournalFailed(Problem):
    """The journal cannot be written: what came with it did not happen, and the number is not used up."""

    code = "journal_failed"

    def __init__(self, where: Path, reason: str, retry_after_s: float = 1.0) -> None:
        super().__init__(
            f"the journal {where} cannot be written ({reason}), so nothing is taken in; questions are answered. Make "
            f"room or make it writable; send again in {retry_after_s:g} s",
            reason=reason,
            retry_after_s=retry_after_s,
        )


class NotWritten(JournalFailed):
    """A file or folder cannot be written, outside of a map at work: what was to be done is not done."""

    def __init__(self, where: Path, reason: str, undone: str = "nothing was changed") -> None:
        Problem.__init__(
            self,
            f"{where} cannot be written ({reason}): {undone}. Make room there, or name a folder that this user may "
            "write to, and begin again",
            reason=reason,
        )


class BadFile(Problem):
    """A file that is to be imported is no exported map, or not a whole one."""

    code = "bad_file"

    def __init__(self, file: Path, what: str) -> None:
        super().__init__(
            f"{file} {what}; wanted a file that `factorbus export` wrote, as it wrote it. Nothing was imported",
            path=str(file),
        )


class JournalInUse(Problem):
    """Another process owns the folder."""

    code = "journal_in_use"

    def __init__(self, where: Path, owner: str) -> None:
        super().__init__(
            f"{where} belongs to a service that runs ({owner or 'it has not said who it is'}): stop that one, give "
            "this one a folder of its own, or start it with --standby to take over when the other ends",
            owner=owner,
        )


class UnsafeJournal(Problem):
    """Others could change the journal, or what takes its place."""

    code = "unsafe_folder"

    def __init__(self, unsafe: UnsafeFolder) -> None:
        super().__init__(unsafe.message, **unsafe.detail)


class JournalDamaged(Problem):
    """The journal is there and cannot be trusted."""

    code = "journal_damaged"

    def __init__(self, where: Path, what: str) -> None:
        super().__init__(
            f"the journal {where} is damaged: {what}; nothing was changed. `factorbus journal check` says more; "
            "restore the folder from a copy and start the service again, or give the map up with `factorbus drop MAP "
            "--damaged` and `factorbus import` an exported file",
            what=what,
        )


class JournalUnreadable(Problem):
    """The journal is there, and the disk does not give it."""

    code = "journal_unreadable"

    def __init__(self, where: Path, reason: str) -> None:
        super().__init__(
            f"the journal {where} cannot be read ({reason}); nothing was changed. Look at the disk, the room on it and "
            "who owns the folder, and start the service again",
            reason=reason,
        )


class JournalVersion(Problem):
    """The journal was written by a version whose form this one does not read."""

    code = "journal_version"

    def __init__(self, where: Path, seen: int, wanted: int) -> None:
        newer = (
            "a newer version wrote it: use that one" if seen > wanted else "export it with the version that wrote it"
        )
        super().__init__(
            f"{where} has the form {seen}, this version reads {wanted}; {newer}", seen=str(seen), wanted=str(wanted)
        )


class JournalDiffers(Problem):
    """Run again, the journal gives something else than it says."""

    code = "journal_differs"

    def __init__(self, where: Path, what: str) -> None:
        super().__init__(
            f"{where}, run again, gives something else: {what}; open it with the version of factorbus that wrote it, "
            "and report this",
            what=what,
        )


class JournalOption(Problem):
    """The solver was set up with an option that this version does not have, or not with such a value."""

    code = "journal_option"

    def __init__(self, name: str, what: str) -> None:
        super().__init__(
            f"the journal's map was solved with the option {name!r}: {what}. Other settings would make other steps, so "
            "it is not opened; open it with the version of factorbus that wrote it",
            name=name,
        )


class MapThere(Problem):
    """A map of that name is in the folder already."""

    code = "map_exists"

    def __init__(self, where: Path) -> None:
        super().__init__(
            f"there is a map {where.name!r} in {where.parent} already, and it stays as it is: give the new one another "
            "name (--as), or drop that one first",
            map=where.name,
        )


class NoJournal(Problem):
    """There is no journal where one was looked for."""

    code = "no_journal"

    def __init__(self, where: Path, known: tuple[str, ...] = ()) -> None:
        there = f"; there are {', '.join(known)}" if known else "; name the folder that `factorbus serve --journal` has"
        super().__init__(f"there is no journal {where}{there}", known=known)
