"""The file that a picture goes to: its ending says which form it has."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from factorbus.proto.problems import Problem
from factorbus.viz import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ENDINGS = (".png", ".svg", ".pdf")


class BadPicture(Problem):
    """A picture that cannot be drawn."""

    code = "bad_picture"


def checked_ending(path: str | os.PathLike[str]) -> str:
    """The ending of `path`, in small letters.  Raises BadPicture for one that no picture can have."""
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        wanted = ", ".join(ENDINGS)
        raise BadPicture(f"{path}: a picture cannot be a {ending or 'file without ending'}; wanted {wanted}")
    return ending


def save(figure: "Figure", path: str | os.PathLike[str], title: str = "") -> None:
    """Write `figure` to a .png, .svg or .pdf file.  Raises BadPicture, or OSError from the file."""
    import matplotlib as mpl

    ending = checked_ending(path)
    with mpl.rc_context(style.SETTINGS):
        figure.savefig(path, dpi=160, metadata={"Title": title} if title and ending != ".png" else None)
