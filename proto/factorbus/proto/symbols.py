"""Variable keys: one int64 that prints as a letter and a number, packed as GTSAM packs its symbols.

key = letter << 56 | index,   letter: 0 (none) or an ASCII letter,   0 <= index < 2^56
"""

from factorbus.proto.problems import BadSymbol

_INDEX_BITS = 56
MAX_INDEX = (1 << _INDEX_BITS) - 1
_MOST_SHOWN = 80


def symbol(letter: str, index: int) -> int:
    """The key of `letter` and `index`: symbol("x", 12) prints as x12.  Raises BadSymbol."""
    if len(letter) > 1 or (letter and not (letter.isascii() and letter.isalpha())):
        raise BadSymbol(f"{letter}{index}", "one ASCII letter")
    if not 0 <= index <= MAX_INDEX:
        raise BadSymbol(f"{letter}{index}", f"an index from 0 to {MAX_INDEX}")
    return (ord(letter) << _INDEX_BITS if letter else 0) | index


def parse_symbol(text: str) -> int:
    """The key that prints as `text`: "x12", "l3", or "7" for a key without a letter.  Raises BadSymbol."""
    letter, digits = (text[:1], text[1:]) if text[:1].isalpha() else ("", text)
    if not (digits.isascii() and digits.isdigit()):
        raise BadSymbol(text[:_MOST_SHOWN], "a letter and a number, such as x12, or a number")
    if len(digits.lstrip("0")) > len(str(MAX_INDEX)):  # Python itself refuses to read very long numbers
        raise BadSymbol(text[:_MOST_SHOWN], f"an index from 0 to {MAX_INDEX}")
    return symbol(letter, int(digits.lstrip("0") or "0"))


def format_symbol(key: int) -> str:
    """How `key` prints: x12; a key that no letter fits prints as its number."""
    letter, index = key >> _INDEX_BITS, key & MAX_INDEX
    if key >= 0 and chr(letter).isalpha():
        return f"{chr(letter)}{index}"
    return str(key)


def symbol_parts(key: int) -> tuple[str, int]:
    """(letter or "", index) of `key`."""
    letter = key >> _INDEX_BITS
    return (chr(letter), key & MAX_INDEX) if key >= 0 and letter else ("", int(key))
