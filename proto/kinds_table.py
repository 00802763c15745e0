"""Write the table of factors in README.md from `factorbus.proto.kinds`.

python proto/kinds_table.py        a test compares
"""

from pathlib import Path

from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS, FactorKind

README = Path(__file__).with_name("README.md")
_HEAD = """\
| factor | connects | measured z | residual r (its order is the order of the information matrix) |
|---|---|---|---|
"""


def main() -> None:
    """Replace the table that is there."""
    text = README.read_text()
    README.write_text(text.replace(found(text), table()))


def table() -> str:
    """A row for each kind."""
    rows = (
        f"| `{kind.name}` | {_ends(kind)} | {kind.measured} | {kind.residual} |\n" for kind in FACTOR_KINDS.values()
    )
    return _HEAD + "".join(rows)


def found(text: str) -> str:
    """The table in the text of the page: up to the next line that is no row."""
    start = text.index(_HEAD)
    return text[start : text.index("\n\n", start) + 1]


def _ends(kind: FactorKind) -> str:
    poses = [VARIABLE_KINDS[end].is_pose for end in kind.connects]
    letters = ["x₁", "x₂"]
    if kind.base:
        letters = ["a", "b" if all(poses) else "l", "m"]
    elif len(poses) == 1:
        letters = ["x"]
    elif not kind.name.startswith("linear_") and all(poses):
        letters = ["a", "b"]
    elif kind.sees_landmark and not kind.name.startswith("linear_"):
        letters = ["a", "y" if kind.connects[1] == "idp" else "l"]
    return ", ".join(f"{end} {letter}" for end, letter in zip(kind.connects, letters, strict=True))


if __name__ == "__main__":
    main()
