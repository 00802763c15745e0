"""`factorbus serve` whose solver does not come out of a step while a file is there: stuck.py FILE ARGUMENTS..."""

import sys
import threading
from pathlib import Path

from factorbus.cli.main import main
from factorbus.solver import Solver

STUCK = Path(sys.argv[1])


def install() -> None:
    """The step of a map whose batch has point2 variables hangs; those of other maps go on."""
    step = Solver.step

    def hanging(self: Solver, *args: object, **kwargs: object) -> object:
        if any(group.kind == "point2" for group in self.estimate()):
            while STUCK.exists():
                threading.Event().wait(0.02)
        return step(self, *args, **kwargs)  # type: ignore[arg-type]

    Solver.step = hanging  # type: ignore[assignment,method-assign]


if __name__ == "__main__":
    install()
    sys.exit(main(sys.argv[2:]))
