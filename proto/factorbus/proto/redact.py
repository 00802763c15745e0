"""What Zenoh says is wrong with a configuration, and endpoints, without the passwords and keys that may be in them.

Zenoh's errors show the line of the file they are about, or the value that was not taken.  Either may be a secret that
stands where it should not, so only the place and what was wanted are passed on.
"""

import re

_SYNTAX = re.compile(r"-->\s*(\d+):(\d+).*?=\s*(expected[^\n]*)", re.DOTALL)
_MESSAGE = re.compile(r'msg:\s*"((?:[^"\\]|\\.)*)"')
_PLACE = re.compile(r"line:\s*(\d+),\s*column:\s*(\d+)")
_SOURCE = re.compile(r"\s+at /\S+\.rs:\d+\.?")
_QUOTED = re.compile(r'\\?"(?:[^"\\]|\\[^"])*\\?"')
_VARIANT = re.compile(r"unknown variant `[^`]*`")
_NUMBER = re.compile(r"((?:integer|floating point|character) )`[^`]*`")
_WORDS = re.compile(r'Str\("([^"]*)"\)')
_OPTIONS = re.compile(r"#[^\s,\])]*")


def reason(error: object) -> str:
    """The text of one of Zenoh's errors, fit to be shown and logged."""
    text = _SOURCE.sub("", str(error))
    if found := _SYNTAX.search(text):
        line, column, wanted = found.groups()
        return f"line {line}, column {column}: {wanted}"
    if found := _MESSAGE.search(text):
        place = _PLACE.search(text)
        where = f"line {place[1]}, column {place[2]}: " if place else ""
        words = _VARIANT.sub("unknown word", _QUOTED.sub("", found[1]))
        return where + re.sub(r"\s+,", ",", _NUMBER.sub(r"\1", words)).strip()
    if found := _WORDS.fullmatch(text):
        return found[1]
    return endpoint(_QUOTED.sub("...", text)).strip()


def endpoint(text: str) -> str:
    """An endpoint, or text with endpoints in it, without what stands behind a `#`: that may hold a private key."""
    return _OPTIONS.sub("#...", text)
