"""Equations of the mathematics are drawn on the site as MathML, every sign of them."""

import re
import sys
from collections import Counter
from html import unescape
from xml.etree import ElementTree

import pytest
from walk import ROOT

sys.path.insert(0, str(ROOT / "docs" / "machinery"))
pytest.importorskip("sphinx")

from equations import SCRIPTS, mathml, rendered

DOCUMENTS = ("service/MATH.md", "workers/MATH.md")


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_equation_is_drawn_with_every_sign(document: str) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    drawn = rendered(text)
    assert not re.search(r"(?<=\n\n) {4}\S", drawn)
    rows = re.findall(r'^<div class="row">(.*)</div>$', drawn, re.M)
    lines = [line for block in re.findall(r"(?<=\n\n)((?: {4}.*\n)+)(?=\n|\Z)", text) for line in block.splitlines()]
    assert len(rows) == len(lines) > 20
    for row, line in zip(rows, lines, strict=True):
        ElementTree.fromstring(f"<row>{row}</row>")  # well formed
        assert Counter(signs(unescape(re.sub("<[^>]*>", "", row)))) == Counter(signs(line)), line


def test_what_is_written_is_what_is_drawn() -> None:
    assert mathml("R_zᵀ") == "<msubsup><mrow><mi>R</mi></mrow><mrow><mi>z</mi></mrow><mrow><mi>T</mi></mrow></msubsup>"
    assert "<mtext>\u00a0with\u00a0</mtext>" in mathml("t with ρ")
    assert mathml("sin θ") == "<mtext>sin\u00a0</mtext><mi>θ</mi>"
    assert mathml("√(x + 1)").startswith("<msqrt><mo>(</mo><mi>x</mi><mo>+</mo><mn>1</mn>")
    assert mathml("[ A  0 ; 0  1 ]").count("<mtr>") == 2
    assert mathml("[ A  0 ; 0  1 ]").count("<mtd>") == 4
    assert mathml("a,   b").count("mspace") == 1
    assert mathml("`max_rounds` < 3") == '<mtext class="option">max_rounds\u00a0</mtext><mo>&lt;</mo><mn>3</mn>'


def test_code_in_fences_stays_code() -> None:
    text = "a\n\n```text\n\n    x² = 1\n\n```\n\n    y = 2  (1.1)\n\nb\n"
    drawn = rendered(text)
    assert "```text\n\n    x² = 1\n\n```" in drawn
    assert '<span class="number">(1.1)</span>' in drawn


def signs(text: str) -> str:
    """Without blanks, ends of matrices' rows and the marks of scripts, options and roots."""
    plain = "".join(SCRIPTS.get(sign, sign) for sign in text.replace("∛", "3"))
    return re.sub(r"[\s;`^_{}√]", "", plain)
