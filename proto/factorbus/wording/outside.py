"""A number that is outside its range, for a person."""


def outside(number: float, least: float, most: float) -> str:
    """The number in six digits, or in all that it has where six would put it inside its range.

    1000000100000 is no "1e+12, wanted at most 1e+12".
    """
    short = f"{number:.6g}"
    return repr(float(number)) if least <= float(short) <= most else short
