"""Which dialect a file speaks, from the names of its records."""

from collections.abc import Mapping
from pathlib import Path

from factorbus.formats.errors import FormatError
from factorbus.formats.lines import Bucket
from factorbus.formats.records import G2O, ISAM, TORO, Dialect

_TORO_ONLY = {"VERTEX", "VERTEX2", "VERTEX3", "EDGE", "EQUIV", "BR"}
_ISAM_ONLY = {"ODOMETRY", "LANDMARK"}


def sniffed(path: Path, buckets: Mapping[str, Bucket]) -> Dialect:
    """The dialect of a file with these records.  Raises FormatError when none has any of them.

    EDGE2 is a record of TORO and of iSAM, which put other numbers into it.  Where nothing else tells them apart, the
    last number does: in iSAM's it belongs to the angle alone and is never 0, in TORO's it joins x and angle and
    mostly is.  Where even that leaves both, the ending decides: .graph is TORO.
    """
    names = set(buckets)
    if names & _ISAM_ONLY:
        return ISAM
    if names & _TORO_ONLY:
        return TORO
    if "EDGE2" in names:
        return _of_edges2(path, buckets["EDGE2"])
    if "EDGE3" in names:
        return TORO if _ending(path) == ".graph" else ISAM
    if names & {*G2O.names, *G2O.refused}:
        return G2O
    first = min(buckets, key=lambda name: buckets[name].numbers[0])
    shown = first if len(first) <= 40 else first[:37] + "..."
    raise FormatError(
        str(path),
        buckets[first].numbers[0],
        f"unknown record {shown!r}",
        "g2o (EDGE_SE2, EDGE_SE3:QUAT, ...), TORO (EDGE2, VERTEX2) or iSAM (ODOMETRY, LANDMARK, EDGE3) records",
    )


def _of_edges2(path: Path, bucket: Bucket) -> Dialect:
    if any(_ends_in_zero(rest) for rest in bucket.rests):
        return TORO
    return TORO if _ending(path) == ".graph" else ISAM


def _ends_in_zero(rest: bytes) -> bool:
    """Whether the last word is 0, in whatever form."""
    last = rest.split()[-1:]
    return bool(last) and last[0].strip(b"+-0.") == b"" and b"0" in last[0]


def _ending(path: Path) -> str:
    return Path(path.name.removesuffix(".gz")).suffix.lower()
