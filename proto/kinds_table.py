"""Write the table of factors in README.md from `factorbus.proto.kinds`.

python proto/kinds_table.py        a test compares
"""

from pathlib import Path

from factorbus.proto.derived_kinds import LETTERS
from factorbus.proto.kinds import FACTOR_KINDS, LINEAR_NAME, VARIABLE_KINDS, FactorKind

README = Path(__file__).with_name("README.md")
_HEAD = """\
| factor | connects | measured z | residual r (its order is the order of the information matrix) |
|---|---|---|---|
"""
_LINEAR = (
    f"| `{LINEAR_NAME}` | any x₁, x₂, … | y of each variable, H of each (rows x its scalars, row by row), b (rows) "
    "| Σ Hₙ (xₙ ⊟ yₙ) + b |\n"
)


def main() -> None:
    """Replace the table that is there."""
    text = README.read_text()
    README.write_text(text.replace(found(text), table()))


def table() -> str:
    """A row for each kind, and one for linear factors."""
    rows = [
        f"| `{kind.name}` | {_ends(kind)} | {kind.measured} | {kind.residual} |\n" for kind in FACTOR_KINDS.values()
    ]
    return _HEAD + "".join(rows) + _LINEAR


def found(text: str) -> str:
    """The table in the text of the page: up to the next line that is no row."""
    start = text.index(_HEAD)
    return text[start : text.index("\n\n", start) + 1]


def _ends(kind: FactorKind) -> str:
    if kind.base:
        base = FACTOR_KINDS[kind.base]
        further = zip(kind.connects[len(base.connects) :], kind.modifiers, strict=True)
        return ", ".join([_ends(base), *(f"{end} {LETTERS[modifier]}" for end, modifier in further)])
    poses = [VARIABLE_KINDS[end].is_pose for end in kind.connects]
    if kind.roles:
        letters = ["f", "v"]
    elif len(poses) == 1:
        letters = ["x"]
    elif all(poses):
        letters = ["a", "b"]
    else:
        letters = ["a", "y" if kind.connects[1] == "idp" else "l"]
    return ", ".join(f"{end} {letter}" for end, letter in zip(kind.connects, letters, strict=True))


if __name__ == "__main__":
    main()
