"""Which solver this is: two with the same fingerprint give the same bits for the same steps."""

import hashlib
from functools import cache
from pathlib import Path

from factorbus.solver.kernels.jit.compile import WIRE_KINDS, sources_hash


@cache
def fingerprint() -> str:
    """A hash of the solver's sources and of all that its kernels depend on: processor, versions, flags."""
    folder = Path(__file__).parent
    digest = hashlib.sha256(sources_hash(folder / "kernels", *(folder / "lenses").glob("*.py"), WIRE_KINDS).encode())
    for path in sorted(folder.rglob("*.py")):
        text = path.read_bytes()
        digest.update(f"{path.name} {len(text)}\n".encode() + text)
    return digest.hexdigest()[:20]
