"""The console script: what is interrupted while its modules are still being imported ends without a traceback.

It imports next to nothing itself, `typing` neither, as a traceback could come of that.
"""

import os
import signal

_INTERRUPTED = 130  # as in `output/exits.py`, which is imported later


def main() -> int:
    """Run the command line; returns the exit code."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # else somebody has it ignored, as `nohup` does in a shell script
        signal.signal(signal.SIGINT, _leave)
    from factorbus.cli.main import main as run

    try:
        signal.signal(signal.SIGINT, before)
        return run()
    except KeyboardInterrupt:
        _leave()
        raise  # not reached


def _leave(*_: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(_INTERRUPTED)
