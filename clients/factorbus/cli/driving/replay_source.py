"""What `factorbus replay` drives: a graph file, a robot's recording, or a data set by its name where there is no such
file."""

from collections.abc import Sequence
from pathlib import Path

from factorbus.cli.output.exits import BAD_FILE, Stopped
from factorbus.datasets import CATALOGUE, Dataset, DatasetProblem, Places, find


def source_of(
    given: Path, places: Places | None = None, catalogue: Sequence[Dataset] = CATALOGUE, else_: str = ""
) -> Path:
    """The file to read for what the command line gave.

    A file that is there is taken as it is; so is every path that cannot be a data set's name, for who reads it says
    best what is wrong with it.  else_: what the command takes beside these.  Raises Stopped.
    """
    known = {word for dataset in catalogue for word in (dataset.name, dataset.file)}
    if given.exists() or (str(given) not in known and (given.suffix or given.name != str(given))):
        return given
    if str(given) not in known:
        raise Stopped(
            "bad_file",
            f"{given}: no such file, and no data set of that name; wanted a g2o, TORO, iSAM, SLAM++, "
            f"PyFactorGraph or JRL file, a map of GLIM's, a recording (.mcap, .bag, rosbag2), "
            f"or one of {', '.join(dataset.name for dataset in catalogue)}{else_}",
            BAD_FILE,
            path=str(given),
        )
    try:
        path = find(str(given), places, catalogue)
    except DatasetProblem as problem:
        raise Stopped(problem.code, problem.message, BAD_FILE, **problem.detail) from problem
    if path is None:
        raise Stopped(
            "not_found",
            f"{given}: no such file, and the data set of that name is not on this machine: "
            f"factorbus datasets fetch {given.name.removesuffix('.g2o')}",
            BAD_FILE,
            path=str(given),
        )
    return path
