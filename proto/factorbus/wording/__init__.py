"""How text for people is put together, and how an exception takes it from one process to another.

Standard library alone, so that everything may import it.
"""

from factorbus.wording.counted import counted
from factorbus.wording.outside import outside

__all__ = ["counted", "outside"]
