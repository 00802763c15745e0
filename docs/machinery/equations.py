"""Equations of the mathematics, which stand there as text, become MathML: browsers draw it, and nothing is fetched.

An equation is a line that is indented by four blanks or more.  What is read in it:

    x_ab  xₐ  x²  x⁻¹  x'  e^δ   subscripts and superscripts
    √x  √(x + y)  ∛x             roots
    [ a  b ; c  d ]              a matrix: rows end at `;`, cells at two blanks
    `name`                       an option
    (3.1) at the end             the number of the equation

Two Latin letters or more are a word, one letter is a variable; all else is an operator.  Every sign is drawn.
"""

import re
from html import escape

from sphinx.application import Sphinx

_PAGES = ("reference/solver-math", "reference/features-math")
_BLOCK = re.compile(r"(?<=\n\n)((?: {4}.*\n)+)(?=\n|\Z)")
_FENCE = re.compile(r"^(```.*?^```)$", re.M | re.S)
_NUMBERED = re.compile(r"(?P<text>.*?)(?: {2,}(?P<number>\(\d+\.\d+\)))?")
_SUPER = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻ᵀ", "0123456789+−T", strict=True))
_SUB = dict(zip("₀₁₂₃₄₅₆₇₈₉₊₋₍₎ₐₑₕᵢⱼₖₗₘₙₒₚᵣₛₜᵤᵥₓ", "0123456789+−()aehijklmnoprstuvx", strict=True))
SCRIPTS = _SUPER | _SUB
_ROOTS = "√∛"
_ATOM = re.compile(
    r"`(?P<code>[^`]+)`|(?P<number>\d+(?:[.,]\d+)*)|(?P<word>[A-Za-z]{2,}(?: [A-Za-z]{2,})*)"
    r"|(?P<letter>[^\W\d_][\u0300-\u036f]*)"
)
# What follows `_` or `^`.
_NAMED = re.compile(rf"\{{([^}}]*)\}}|([^\W{re.escape(''.join(SCRIPTS))}]+[\u0300-\u036f]*)|(.)")


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx.  After `borrowed`, which puts the document on the page."""
    app.connect("source-read", _fill, priority=600)
    return {"parallel_read_safe": True}


def _fill(_app: Sphinx, page: str, content: list[str]) -> None:
    if page in _PAGES:
        content[0] = rendered(content[0])


def rendered(text: str) -> str:
    """A document with its indented lines as MathML."""
    parts = _FENCE.split(text)
    return "".join(part if part.startswith("```") else _BLOCK.sub(_block, part) for part in parts)


def _block(found: re.Match[str]) -> str:
    rows = "".join(f"{_row(line[4:])}\n" for line in found[1].splitlines())
    return f'<div class="equation">\n{rows}</div>\n'


def _row(line: str) -> str:
    found = _NUMBERED.fullmatch(line.strip())
    assert found is not None
    number = f'<span class="number">{found["number"]}</span>' if found["number"] else ""
    return f'<div class="row"><math>{mathml(found["text"])}</math>{number}</div>'


def mathml(equation: str) -> str:
    """What stands within `<math>`."""
    drawn, at = [], 0
    while at < len(equation):
        if equation[at] == " ":
            end = at + len(equation[at:]) - len(equation[at:].lstrip(" "))
            drawn.append('<mspace width="2em"/>' if end - at > 1 else "")
            at = end
        else:
            node, at = _scripted(equation, at)
            drawn.append(node)
    return "".join(drawn)


def _scripted(text: str, at: int) -> tuple[str, int]:
    """The atom at `at` with its subscript and superscript, and where it ends."""
    base, at = _atom(text, at)
    below, above = "", ""
    while at < len(text):
        sign = text[at]
        if sign in _SUB or sign in _SUPER:
            of = _SUB if sign in _SUB else _SUPER
            end = next((i for i in range(at, len(text)) if text[i] not in of), len(text))
            node, at = _plain("".join(of[each] for each in text[at:end])), end
            below, above = (below + node, above) if of is _SUB else (below, above + node)
        elif sign == "'":
            above, at = f"{above}<mo>'</mo>", at + 1
        elif sign in "_^" and at + 1 < len(text):
            found = _NAMED.match(text, at + 1)
            assert found is not None
            inner, _, deeper = (found[1] or found[2] or found[3]).partition("_")
            node = _plain(inner) if not deeper else _sub(_plain(inner), _plain(deeper))
            below, above = (below + node, above) if sign == "_" else (below, above + node)
            at = found.end()
        else:
            break
    return _sub(base, below, above), at


def _atom(text: str, at: int) -> tuple[str, int]:
    sign = text[at]
    if sign in _ROOTS and at + 1 < len(text):
        if text[at + 1] == "(":
            end = _closing(text, at + 1, "()")
            inner, at = f"<mo>(</mo>{mathml(text[at + 2 : end])}<mo>)</mo>", end + 1
        else:
            inner, at = _scripted(text, at + 1 + (text[at + 1] == " "))
        return (f"<msqrt>{inner}</msqrt>" if sign == "√" else f"<mroot><mrow>{inner}</mrow><mn>3</mn></mroot>"), at
    if sign == "[" and (end := _closing(text, at, "[]")) and ";" in text[at:end]:
        return _matrix(text[at + 1 : end]), end + 1
    found = _ATOM.match(text, at)
    if found is None:
        return f"<mo>{escape(sign)}</mo>", at + 1
    kind, end, before = str(found.lastgroup), found.end(), text[at - 1] if at else ""
    return _drawn(kind, found[kind], before, text[end : end + 1]), end


def _drawn(kind: str, text: str, before: str, after: str) -> str:
    if kind == "number":
        return f"<mn>{text}</mn>"
    if kind == "letter":
        return f"<mi>{text}</mi>"
    # A word keeps the blanks beside it: `t with ρ`.
    words = ("\u00a0" if before == " " else "") + escape(text) + ("\u00a0" if after == " " else "")
    words = words.replace(" ", "\u00a0")
    return f'<mtext class="option">{words}</mtext>' if kind == "code" else f"<mtext>{words}</mtext>"


def _matrix(inner: str) -> str:
    rows = []
    for row in inner.split(";"):
        cells = re.split(r" {2,}", row.strip())
        rows.append("<mtr>" + "".join(f"<mtd>{mathml(cell)}</mtd>" for cell in cells) + "</mtr>")
    return f"<mrow><mo>[</mo><mtable>{''.join(rows)}</mtable><mo>]</mo></mrow>"


def _closing(text: str, at: int, pair: str) -> int:
    """Where the bracket that opens at `at` is closed, or 0."""
    depth = 0
    for i in range(at, len(text)):
        depth += (text[i] == pair[0]) - (text[i] == pair[1])
        if depth == 0:
            return i
    return 0


def _plain(text: str) -> str:
    """A script: letters and numbers as they are."""
    if text.isdigit():
        return f"<mn>{text}</mn>"
    return f"<mi>{escape(text)}</mi>" if text.isalpha() else f"<mtext>{escape(text)}</mtext>"


def _sub(base: str, below: str, above: str = "") -> str:
    parts = [f"<mrow>{each}</mrow>" for each in (base, below, above) if each]
    tag = {(True, True): "msubsup", (True, False): "msub", (False, True): "msup"}.get((bool(below), bool(above)))
    return f"<{tag}>{''.join(parts)}</{tag}>" if tag else base
