"""Which dialect a file speaks, from the names of its records."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from factorbus.formats.errors import FormatError
from factorbus.formats.lines import Bucket
from factorbus.formats.records import DIALECTS, G2O, ISAM, SLAMPP, TORO, Dialect

_TORO_ONLY = {"VERTEX", "VERTEX3", "EDGE", "EQUIV", "BR"}
_ISAM_TOO = {"ODOMETRY", "LANDMARK"}  # iSAM has them, and so has SLAM++
_SLAMPP_ONLY = {"LANDMARK2", "LANDMARK2:XY", "EDGE3:AXISANGLE"}
_TORO_YY, _TORO_TT = 7, 8  # fields of an EDGE2 that are on the diagonal in TORO, and mostly 0 elsewhere


@dataclass(frozen=True, slots=True)
class Guess:
    """A dialect, and where another one has the same records, why it is this one: a note for people."""

    dialect: Dialect
    why: str = ""


def dialect_named(file: str, name: str) -> Guess:
    """The dialect that somebody named.  Raises FormatError when there is none of that name."""
    if name not in DIALECTS:
        there = ", ".join((*DIALECTS, "pyfg", "jrl", "tum", "bal", "glim", "colmap", "nuscenes"))
        raise FormatError(file, None, f"dialect {name!r}", f"one of {there}")
    return Guess(DIALECTS[name])


def sniffed(path: Path, buckets: Mapping[str, Bucket]) -> Guess:
    """The dialect of a file with these records.  Raises FormatError when none has any of them.

    EDGE2 is a record of TORO, of iSAM and of SLAM++, which put other numbers into it.  Where nothing else tells TORO
    apart, the last number does: in iSAM's and SLAM++'s it belongs to the angle alone and is never 0, in TORO's it joins
    x and angle and mostly is.  Where even that leaves both, the ending decides: .graph is TORO.  iSAM and SLAM++ (a
    square root of the information, and the information itself) cannot be distinguished by their numbers: without
    vertices a file is taken for iSAM's.
    """
    names = set(buckets)
    if names & _SLAMPP_ONLY:
        return Guess(SLAMPP, _beside_g2o(names))
    if "VERTEX2" in names and (names & _ISAM_TOO or _is_never_toro(buckets.get("EDGE2"))):
        seen = ", ".join(sorted(names & (_ISAM_TOO | {"EDGE2"})))
        return Guess(SLAMPP, _assumed(SLAMPP, f"it has VERTEX2 beside {seen} with the information row by row", TORO))
    if names & _ISAM_TOO:
        return Guess(ISAM, _isam("it has " + " and ".join(sorted(names & _ISAM_TOO)) + ", and no vertices"))
    if names & _TORO_ONLY or "VERTEX2" in names:
        return Guess(TORO)
    if "EDGE2" in names:
        return _of_edges2(path, buckets["EDGE2"])
    if "EDGE3" in names:
        if _ending(path) == ".graph":
            return Guess(TORO)
        return Guess(ISAM, _assumed(ISAM, "it has EDGE3 alone and does not end in .graph", TORO, SLAMPP))
    if names & set(G2O.names):
        return Guess(G2O)
    first = min(buckets, key=lambda name: buckets[name].numbers[0])
    shown = first if len(first) <= 40 else first[:37] + "..."
    raise FormatError(
        str(path),
        buckets[first].numbers[0],
        f"unknown record {shown!r}",
        "g2o (EDGE_SE2, EDGE_SE3:QUAT, ...), TORO (EDGE2, VERTEX2), iSAM (ODOMETRY, LANDMARK, EDGE3) or PyFactorGraph "
        "records, or TUM",
    )


def _beside_g2o(names: set[str]) -> str:
    """What SLAM++'s records in a file are taken for that has g2o's, too; empty: it has none of g2o."""
    theirs, ours = sorted(names & _SLAMPP_ONLY), sorted(names & set(G2O.names))
    if not ours:
        return ""
    return (
        f"{' and '.join(theirs)} read beside {', '.join(ours)} of g2o as {SLAMPP.name} has it: x y in the frame of the "
        "pose, and the information itself, row by row; if that is wrong: --dialect g2o, which leaves it out"
    )


def _of_edges2(path: Path, bucket: Bucket) -> Guess:
    if any(_ends_in_zero(rest) for rest in bucket.rests):
        return Guess(TORO)
    if _ending(path) == ".graph" and not _is_never_toro(bucket):
        return Guess(TORO, _assumed(TORO, "it has EDGE2 alone and ends in .graph", ISAM, SLAMPP))
    return Guess(ISAM, _isam("it has EDGE2 without vertices, none of which ends in 0"))


def _isam(because: str) -> str:
    return _assumed(ISAM, because, SLAMPP)


def _assumed(dialect: Dialect, because: str, *others: Dialect) -> str:
    kind = {"isam": "square roots of the information", "slam++": "the information, row by row"}
    told = f" ({kind[dialect.name]})" if dialect.name in kind else ""
    instead = " or ".join(
        f"--dialect {other.name}" + (f" ({kind[other.name]})" if other.name in kind else "") for other in others
    )
    return f"read as {dialect.name} text{told}, because {because}; if that is wrong: {instead}"


def _is_never_toro(bucket: Bucket | None) -> bool:
    """Whether a line has 0 where TORO has the weight of y or of the angle."""
    return bucket is not None and any(_is_zero(rest, _TORO_YY) or _is_zero(rest, _TORO_TT) for rest in bucket.rests)


def _ends_in_zero(rest: bytes) -> bool:
    """Whether the last word is 0, in whatever form."""
    return _is_zero(rest, -1)


def _is_zero(rest: bytes, at: int) -> bool:
    words = rest.split()
    if not words or at >= len(words):
        return False
    return words[at].strip(b"+-0.") == b"" and b"0" in words[at]


def _ending(path: Path) -> str:
    return Path(path.name.removesuffix(".gz")).suffix.lower()
