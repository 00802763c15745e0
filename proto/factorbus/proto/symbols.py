"""Variable keys: one int64 that prints as a letter and a number, packed as GTSAM packs its symbols.

key = letter << 56 | index,   letter: 0 (none) or an ASCII letter,   0 <= index < 2^56
"""

import operator

from factorbus.proto.problems import BadSymbol

_INDEX_BITS = 56
MAX_INDEX = (1 << _INDEX_BITS) - 1
MIN_KEY, MAX_KEY = -(1 << 63), (1 << 63) - 1
_MOST_SHOWN = 80


def symbol(letter: str, index: int) -> int:
    """The key of `letter` and `index`: symbol("x", 12) prints as x12.  Raises BadSymbol."""
    if not isinstance(letter, str) or len(letter) > 1 or (letter and not (letter.isascii() and letter.isalpha())):
        raise BadSymbol(f"{letter}{index}", "one ASCII letter")
    try:
        number = operator.index(index)
    except TypeError:  # an array has the method, and is no index
        number = -1
    if not 0 <= number <= MAX_INDEX:
        raise BadSymbol(f"{letter}{index}", f"an index from 0 to {MAX_INDEX}")
    return (ord(letter) << _INDEX_BITS if letter else 0) | number


def parse_symbol(text: str) -> int:
    """The key that prints as `text`: "x12", "l3", or "7" for a key without a letter.  Raises BadSymbol.

    A number alone is the key itself, also one above MAX_INDEX, as a time stamp in nanoseconds is, or below 0.
    """
    if text[:1] == "-":
        return _below_0(text)
    letter, digits = (text[:1], text[1:]) if text[:1].isalpha() else ("", text)
    if not (digits.isascii() and digits.isdigit()):
        raise BadSymbol(text[:_MOST_SHOWN], "a letter and a number, such as x12, or a number")
    most, digits = (MAX_INDEX if letter else MAX_KEY), digits.lstrip("0") or "0"
    if len(digits) > len(str(most)) or int(digits) > most:  # Python itself refuses to read very long numbers
        raise BadSymbol(text[:_MOST_SHOWN], f"{'an index' if letter else 'a number'} from 0 to {most}")
    return symbol(letter, int(digits)) if letter else int(digits)


def _below_0(text: str) -> int:
    digits = text[1:].lstrip("0") or "0"
    if not (text[1:].isascii() and text[1:].isdigit()) or len(digits) > len(str(MIN_KEY)) or -int(digits) < MIN_KEY:
        raise BadSymbol(text[:_MOST_SHOWN], f"a letter and a number, such as x12, or a number from {MIN_KEY}")
    return -int(digits)


def format_symbol(key: int) -> str:
    """How `key` prints: x12; a key that no letter fits prints as its number."""
    letter, index = key >> _INDEX_BITS, key & MAX_INDEX
    if key >= 0 and chr(letter).isalpha():
        return f"{chr(letter)}{index}"
    return str(key)


def symbol_parts(key: int) -> tuple[str, int]:
    """(letter, index) of `key`; ("", key) of one that no letter fits, with all its digits."""
    letter = key >> _INDEX_BITS
    return (chr(letter), int(key) & MAX_INDEX) if key >= 0 and chr(letter).isalpha() else ("", int(key))
