"""CHOLMOD, as an oracle."""

from typing import Any

import pytest


def cholmod() -> Any:
    """The module sksparse.cholmod; where it is not installed the test is skipped, and says why."""
    why = "scikit-sparse is not installed (apt-get install libsuitesparse-dev, pip install 'factorbus[cholmod]')"
    return pytest.importorskip("sksparse.cholmod", reason=why)
