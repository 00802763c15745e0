"""Who sends inserts: keys that were taken apart before, and of which Zenoh knows where they lead.

Zenoh looks for who answers a query among all keys that anybody has declared, anew for every query (measured: 30 of
500 µs with one map, 500 µs after a thousand were watched), but for a query on a key that is declared itself: of that
it remembers the way.  What a client declares stays with the client, so the keys of those at work are declared here.
"""

from collections.abc import Callable

from factorbus.proto import keys
from factorbus.service.maps.serial_executor import SerialExecutor

_MOST = 4096


class Senders:
    """The (map, client) of keys of inserts.  `find` is for any thread.

    declare(key) makes a key known and gives what takes that back; it runs on the control thread.
    """

    def __init__(
        self, control: SerialExecutor, declare: Callable[[str], Callable[[], None]], most: int = _MOST
    ) -> None:
        self._control, self._declare, self._most = control, declare, most
        self._found: dict[str, tuple[str, str]] = {}
        self._forget: dict[str, Callable[[], None]] = {}  # on the control thread only

    def find(self, key: str) -> tuple[str, str]:
        """(map, client) of `key`.  Raises BadName."""
        return self._found.get(key) or _taken_apart(key)

    def remember(self, key: str, sender: tuple[str, str]) -> None:
        """Something that can be read came from there: more will."""
        if key not in self._found:
            self._found[key] = sender
            self._control.hand(self._make_known, key)

    def forget(self, name: str) -> None:
        """Map `name` is no more, and who sent to it sends nothing.  On the control thread."""
        for key in [key for key, (of, _) in list(self._found.items()) if of == name]:
            self._found.pop(key, None)
            if key in self._forget:
                self._forget.pop(key)()

    def _make_known(self, key: str) -> None:
        if key in self._forget:
            return
        while len(self._forget) >= self._most:
            oldest = next(iter(self._forget))
            self._found.pop(oldest, None)
            self._forget.pop(oldest)()
        self._forget[key] = self._declare(key)


def _taken_apart(key: str) -> tuple[str, str]:
    name, client = keys.below_map(key)
    return keys.checked_name("map", name), keys.checked_name("client", client)
