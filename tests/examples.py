"""How many examples a property is tried at: as many as its test says, or `FACTORBUS_EXAMPLES` where that is fewer.

An emulated processor takes some twenty times as long for each.
"""

import os

from hypothesis import settings

MOST = int(os.environ.get("FACTORBUS_EXAMPLES", "1000000"))
USUAL = min(settings().max_examples, MOST)


def examples(count: int) -> settings:
    """The decorator of a property that is tried at `count` examples, without a deadline for each."""
    return settings(max_examples=min(count, MOST), deadline=None)
