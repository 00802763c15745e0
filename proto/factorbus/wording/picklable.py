"""Exceptions that go whole from one process to another."""

from typing import Any


class Picklable(BaseException):
    """Base of exceptions whose constructors take something else than their text.

    Python would call the constructor with the text again, in the process that they are raised in next, and end that
    with a TypeError: a pool of processes breaks.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return _remade, (type(self), self.args, self.__dict__)


def _remade(kind: type[BaseException], args: tuple[Any, ...], state: dict[str, Any]) -> BaseException:
    """What it was, without a call of its constructor."""
    problem = kind.__new__(kind, *args)
    problem.__dict__.update(state)
    return problem
