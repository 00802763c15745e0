"""What a map keeps of places that are driven through again and again."""

from dataclasses import dataclass

from factorbus.solver.option_ranges import check_within


@dataclass(frozen=True, slots=True)
class KeepPolicy:
    """spacing_m, poses: how many poses stay within this distance of each other, metres; the others are redundant.

    window: the newest poses of each letter, which stay.  landmarks: a pose stays that sees a landmark which no more
    poses than so see.  loss: the most that may be lost for each pose that goes, nats (`eliminating`).

    Raises BadOption.
    """

    spacing_m: float = 2.0
    poses: int = 1
    window: int = 50
    landmarks: int = 2
    loss: float = 1.0

    def __post_init__(self) -> None:
        check_within("keep spacing_m", self.spacing_m, 1e-3, 1e6)
        check_within("keep poses", self.poses, 1, 1000, whole=True)
        check_within("keep window", self.window, 1, 10**9, whole=True)
        check_within("keep landmarks", self.landmarks, 1, 10**9, whole=True)
        check_within("keep loss", self.loss, 0.0, 1e6)
