"""Words for what a batch optimum was found from, and for what follows where it is better than the map."""

_WORDS = {"values": "the map's own values", "odometry": "composed odometry", "rotations": "averaged rotations"}


def optimum_from(start: str, file_values: bool = False) -> str:
    """ "optimum from averaged rotations".  file_values: the map began with the values of a file."""
    if file_values and start == "values":
        return "optimum from the file's values"
    return f"optimum from {_WORDS.get(start, 'a start that is not told')}"
