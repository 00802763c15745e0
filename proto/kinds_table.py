"""Write the table of factors in README.md from `factorbus.proto.kinds`.

python proto/kinds_table.py        a test compares
"""

from pathlib import Path

from factorbus.proto import inertial
from factorbus.proto.kinds import FACTOR_KINDS, LINEAR_NAME, VARIABLE_KINDS, FactorKind

README = Path(__file__).with_name("README.md")
_HEAD = """\
| factor | connects | measured z | residual r (its order is the order of the information matrix) |
|---|---|---|---|
"""
_FAMILIES = (
    f"| `{LINEAR_NAME}` | any x₁, x₂, … | y of each variable, H of each (rows x its scalars, row by row), b (rows) "
    "| Σ Hₙ (xₙ ⊟ yₙ) + b |\n"
    f"| `{inertial.NAME}` | se3 a, vector3 vₐ, vector6 βₐ, se3 b, vector3 v_b, vector6 β_b | {inertial.MEASURED} "
    f"| {inertial.DIFFERENCE} |\n"
)


def main() -> None:
    """Replace the table that is there."""
    text = README.read_text()
    README.write_text(text.replace(found(text), table()))


def table() -> str:
    """A row for each kind, and one for each family of kinds: linear and inertial factors."""
    rows = [
        f"| `{kind.name}` | {_ends(kind)} | {kind.measured} | {kind.residual} |\n" for kind in FACTOR_KINDS.values()
    ]
    return _HEAD + "".join(rows) + _FAMILIES


def found(text: str) -> str:
    """The table in the text of the page: up to the next line that is no row."""
    start = text.index(_HEAD)
    return text[start : text.index("\n\n", start) + 1]


def _ends(kind: FactorKind) -> str:
    poses = [VARIABLE_KINDS[end].is_pose for end in kind.connects]
    if kind.base:
        letters = ["a", "b" if all(poses) else "l", "m"]
    elif len(poses) == 1:
        letters = ["x"]
    elif all(poses):
        letters = ["a", "b"]
    else:
        letters = ["a", "y" if kind.connects[1] == "idp" else "l"]
    return ", ".join(f"{end} {letter}" for end, letter in zip(kind.connects, letters, strict=True))


if __name__ == "__main__":
    main()
