"""When a journal's next checkpoint is due."""

import threading

_SHARE = 0.05  # of the time that steps take, for copies of the solver's state


class CheckpointPlan:
    """When the solver's state is to be written next, and the thread that does.

    every_s: of steps.  steps_s: of those that a restart would make again already.  differs: what is noted beside each,
    see `Checkpoint`.
    """

    def __init__(self, every_s: float, steps_s: float = 0.0, differs: str = "") -> None:
        self.every_s, self.differs, self.steps_s, self.copying_s = every_s, differs, steps_s, 0.0
        self.thread: threading.Thread | None = None
        self.record = 0

    def due(self) -> bool:
        """Steps have taken long enough, copying takes a small share of it, and none is being written."""
        waits = max(self.every_s, self.copying_s / _SHARE)
        return self.steps_s >= waits and (self.thread is None or not self.thread.is_alive())
