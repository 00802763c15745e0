"""A machine whose name has no address is told apart from one where nothing listens."""

import pytest

from factorbus.client import Unavailable, connect


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("tcp/nohost.invalid:7447", "there is no address for the name nohost.invalid; is it spelt right"),
        ("tcp/127.0.0.1:1", "nothing listens at tcp/127.0.0.1:1; start a service"),
    ],
)
def test_a_name_that_does_not_resolve_is_said(endpoint: str, said: str) -> None:
    with pytest.raises(Unavailable) as nobody:
        connect(endpoint, client="robot", timeout_s=5, listening_s=0)
    assert said in nobody.value.message
