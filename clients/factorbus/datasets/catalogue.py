"""What is known of a data set, and where its source is."""

from collections.abc import Sequence
from dataclasses import dataclass

from factorbus.datasets.errors import UnknownDataset


@dataclass(frozen=True, slots=True)
class Source:
    """Where a data set comes from.

    repository: owner/name on GitHub, "" for the gtsam wheel.  paths: of one commit, or below gtsam/Data; the form
    says what is in each.  sha256: of each path, None where none was recorded (the converted file's still decides).
    form: a name in `factorbus.datasets.convert.FORMS`.
    """

    form: str
    paths: tuple[str, ...]
    sha256: tuple[str | None, ...]
    repository: str = ""
    commit: str = ""

    @property
    def where(self) -> str:
        """In words."""
        if not self.repository:
            return f"gtsam wheel, gtsam/Data/{', '.join(self.paths)}"
        return f"github.com/{self.repository} at {self.commit[:10]}, {', '.join(self.paths)}"


@dataclass(frozen=True, slots=True)
class Dataset:
    """One data set in the converted form: g2o text, edges in time order.

    paper: its name in the paper of 2013, "" where it is not one of the paper's six.  edges: pose to pose; observations:
    pose to landmark.  vertices: number of vertex lines.  optimum: the lowest χ² = Σ rᵀΩr known, g2o residuals,
    vertex 0 fixed.  download: the public source; wheel: a file of the gtsam wheel from which the same bytes come.
    near: a file that is like this one but not the same, and why it will not do.
    """

    name: str
    what: str
    paper: str
    kind: str
    poses: int
    landmarks: int
    edges: int
    observations: int
    vertices: int
    optimum: float
    sha256: str
    download: Source | None = None
    wheel: Source | None = None
    near: str = ""

    @property
    def file(self) -> str:
        return f"{self.name}.g2o"


def dataset_named(name: str, catalogue: Sequence[Dataset]) -> Dataset:
    """The data set of that name, with or without .g2o.  Raises UnknownDataset."""
    for each in catalogue:
        if name in (each.name, each.file):
            return each
    raise UnknownDataset(name, tuple(each.name for each in catalogue))
