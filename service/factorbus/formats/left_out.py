"""What of a file, or of a graph, is left out: counted, said, and refused where nothing may be."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.proto.arrays import I64
from factorbus.wording import counted

_SHOWN = 5


class FileNotes(tuple[str, ...]):
    """What was left out of a file, a sentence for each reason, for people; counts: the same by name, for programs."""

    counts: dict[str, int]

    def __new__(cls, notes: Iterable[str] = (), counts: Mapping[str, int] | None = None) -> "FileNotes":
        made = super().__new__(cls, notes)
        made.counts = dict(counts or {})
        return made

    def and_those(self, more: "FileNotes") -> "FileNotes":
        """Of two files, or of two looks at one: counts add up."""
        return FileNotes((*self, *more), Counter(self.counts) + Counter(more.counts))


# Names that are nouns have a singular; names of records and kinds do not.
_ONE = {
    "vertices": "vertex", "poses": "pose", "points": "point", "landmarks": "landmark", "variables": "variable",
    "factors": "factor", "time stamps": "time stamp", "fixed variables": "fixed variable",
    "mounts": "mount", "frames": "frame",
    "ground truth values": "ground truth value", "potential outliers": "potential outlier", "outliers": "outlier",
}  # fmt: skip


@dataclass(slots=True)
class LeftOut:
    """Collects what is left out of one file.

    counts: by the name of the record, or of the kind.  notes: sentences for people, one for each reason.  strict:
    refuse instead.  whole: the graph is used as it is, and not its replay.  Only what the file says and the graph does
    not is left out; what becomes something else is a note.
    """

    file: str
    strict: bool = False
    whole: bool = False
    counts: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def leave(self, name: str, lines: I64 | list[int], why: str) -> None:
        """`name`, which stands on `lines`, is left out.  Raises FormatError when strict."""
        if not len(lines):
            return
        if self.strict:
            raise FormatError(
                self.file, int(np.min(lines)), f"{name}, {why}", "nothing that would have to be left out (strict)"
            )
        self.counts[name] = self.counts.get(name, 0) + len(lines)
        self.notes.append(f"{_counted(len(lines), name)} left out: {why}")

    def drop(self, name: str, count: int, why: str) -> None:
        """The same for what stands on no line.  Raises FormatError when strict."""
        if count and self.strict:
            raise self._refused(count, name, why)
        if count:
            self.counts[name] = self.counts.get(name, 0) + count
            self.notes.append(f"{_counted(count, name)} left out: {why}")

    def set_aside(self, name: str, count: int, why: str) -> None:
        """Note what the graph keeps and no step of a replay has.  Raises FormatError when strict, unless `whole`."""
        if count and self.strict and not self.whole:
            raise self._refused(count, name, why)
        if count:
            self.counts[name] = self.counts.get(name, 0) + count
            self.notes.append(f"{_counted(count, name)} that replay and solve leave out: {why}")

    def change(self, name: str, count: int, into: str, why: str) -> None:
        """Note what stays in the file, but says less there: written as `into`.  Raises FormatError when strict."""
        if count and self.strict:
            raise self._refused(count, name, why)
        if count:
            self.counts[name] = self.counts.get(name, 0) + count
            self.notes.append(f"{_counted(count, name)} written {into}: {why}")

    def told(self) -> FileNotes:
        """All of it."""
        return FileNotes(self.notes, self.counts)

    def say(self, note: str) -> None:
        """Nothing is left out, but somebody may want to know."""
        self.notes.append(note)

    def _refused(self, count: int, name: str, why: str) -> FormatError:
        return FormatError(
            self.file, None, f"{_counted(count, name)}, {why}", "nothing that would be left out (strict)"
        )


def _counted(count: int, name: str) -> str:
    return counted(count, _ONE.get(name, name), f"{name}es" if name.endswith(" loss") else name)


def shown(names: list[str]) -> str:
    """The first few."""
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
