"""What a service says of loop closures that it tests or weighs, and the command line beside it."""

import subprocess
import sys

from factorbus.client import Map


def ran(*arguments: str, code: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "factorbus.cli", *arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == code, done.stderr
    return done.stdout


def told(joined: Map) -> dict[int, tuple[str, str]]:
    found = joined.suspects(every=True)
    return {k: (s, r) for k, s, r in zip(found.factors.tolist(), found.states, found.reasons, strict=True)}


def values(joined: Map) -> list[bytes]:
    return [group.values.tobytes() for group in joined.ask_estimate().variables if group.values is not None]
