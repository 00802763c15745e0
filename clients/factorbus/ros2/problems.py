"""What can be wrong with what a robot says, or with how it is named."""

from pathlib import Path

from factorbus.proto.problems import Problem


class BadRosMessage(Problem):
    """A message that is not used: bytes that are not of its type, a frame, a covariance or a number that cannot be."""

    code = "bad_ros_message"

    def __init__(self, topic: str, found: str, wanted: str) -> None:
        super().__init__(
            f"{topic}: {found}; wanted {wanted}; {self._whole} is not used", topic=topic, seen=found, wanted=wanted
        )

    _whole = "the message"

    @property
    def of_message(self) -> bool:
        """It is the whole message that is not used, and not a part of it."""
        return True


class BadRosEdge(BadRosMessage):
    """An edge or a node of a graph that is not used; the rest of the message is."""

    _whole = "it"

    def __init__(self, topic: str, part: str, found: str, wanted: str) -> None:
        super().__init__(topic, f"{part}: {found}", wanted)

    @property
    def of_message(self) -> bool:
        """The rest of the message is used."""
        return False


class Unusable(Problem):
    """A message on which the bridge itself fails."""

    code = "internal"

    def __init__(self, topic: str, fault: Exception) -> None:
        super().__init__(
            f"{topic}: the bridge failed on a message ({type(fault).__name__}: {fault}); it is not used, others "
            "are. Report this, with the log",
            topic=topic,
        )


class BadRecording(Problem):
    """A recording that cannot be read, or has nothing to drive by."""

    code = "bad_file"

    def __init__(self, path: Path, found: str, wanted: str) -> None:
        super().__init__(f"{path}: {found}; wanted {wanted}", file=str(path), line=None, seen=found, wanted=wanted)


class BadRosName(Problem):
    """A topic, namespace, node, letter or mount that cannot be."""

    code = "bad_ros_name"

    def __init__(self, what: str, name: str, wanted: str) -> None:
        super().__init__(f"{what} {name!r} cannot be; wanted {wanted}", name=name, seen=name, wanted=wanted)
