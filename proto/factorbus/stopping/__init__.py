"""When a process is asked to stop: an event that SIGTERM and SIGINT set.

Standard library alone, so that everything may import it.
"""

from factorbus.stopping.signals import STOPPING, listening, signalled, stop_on_signals

__all__ = ["STOPPING", "listening", "signalled", "stop_on_signals"]
