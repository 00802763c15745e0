"""Our docstrings are plain text; this makes of them what Sphinx reads, without a sign taken for markup.

`code` stays code; a paragraph that is indented, or laid out in columns, stays as it is laid out: equations, examples,
tables of shapes.
"""

import re
from collections.abc import Iterable
from typing import Any

from sphinx.application import Sphinx

_CODE = re.compile(r"(\w?)`([^`\n]+)`(\w?)")
_SIGNS = re.compile(r"([*|\\]|_(?!\w))")
_LAID_OUT = re.compile(r"^\s|^\||\S {3,}\S")


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", _rewrite)
    return {"parallel_read_safe": True}


def _rewrite(_app: Sphinx, _what: str, _name: str, _obj: object, _options: Any, lines: list[str]) -> None:
    lines[:] = [] if lines and lines[0].startswith("Alias for field number") else rewritten(lines)


def rewritten(lines: Iterable[str]) -> list[str]:
    """reStructuredText of a docstring's lines."""
    found: list[str] = []
    for paragraph in re.split(r"\n\s*\n", "\n".join(lines).strip("\n")):
        rows = paragraph.split("\n")
        if any(_LAID_OUT.search(row) for row in rows):
            found += ["::", "", *(f"    {row}" for row in rows), ""]
        elif paragraph:
            found += [*map(_text, _as_one(rows)), ""]
    return found


def _as_one(rows: list[str]) -> list[str]:
    """A code span that goes over the end of a line is brought onto one."""
    joined = [rows[0]]
    for row in rows[1:]:
        if joined[-1].count("`") % 2:
            joined[-1] += f" {row}"
        else:
            joined.append(row)
    return joined


def _text(row: str) -> str:
    parts, at = [], 0
    for span in _CODE.finditer(row):
        before, code, after = span.groups()
        parts += [_SIGNS.sub(r"\\\1", row[at : span.start()] + before), "\\ " if before else "", f"``{code.strip()}``"]
        parts += [f"\\ {after}" if after else ""]
        at = span.end()
    return "".join(parts) + _SIGNS.sub(r"\\\1", row[at:])
