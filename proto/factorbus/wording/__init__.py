"""How text for people is put together.

Standard library alone, so that everything may import it.
"""

from factorbus.wording.counted import counted

__all__ = ["counted"]
