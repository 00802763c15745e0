"""Write the tables of factors, and of the operations of own kinds, in README.md from the code.

python proto/kinds_table.py        a test compares
"""

from pathlib import Path

from factorbus.proto import inertial
from factorbus.proto.derived_kinds import LETTERS
from factorbus.proto.expressions.operations import ABSENT, LEGEND, OPERATIONS
from factorbus.proto.kinds import FACTOR_KINDS, LINEAR_NAME, VARIABLE_KINDS, FactorKind

README = Path(__file__).with_name("README.md")
_HEAD = """\
| factor | connects | measured z | residual r (its order is the order of the information matrix) |
|---|---|---|---|
"""
_OPERATIONS_HEAD = """\
| operation | takes → gives | what it gives |
|---|---|---|
"""
_FAMILIES = (
    f"| `{LINEAR_NAME}` | any x₁, x₂, … | y of each variable, H of each (rows x its scalars, row by row), b (rows) "
    "| Σ Hₙ (xₙ ⊟ yₙ) + b |\n"
)
_MOMENTS = "se3 a, vector3 vₐ, vector6 βₐ, se3 b, vector3 v_b, vector6 β_b"
_FURTHER = {(True, False): ", se3 m", (False, True): ", vector3 g", (True, True): ", se3 m, vector3 g"}


def main() -> None:
    """Replace the table that is there."""
    text = README.read_text()
    text = text.replace(found(text), table())
    README.write_text(text.replace(found(text, _OPERATIONS_HEAD, 2), operations()))


def table() -> str:
    """A row for each kind, and one for each family of kinds: linear and inertial factors."""
    rows = [
        f"| `{kind.name}` | {_ends(kind)} | {kind.measured} | {kind.residual} |\n" for kind in FACTOR_KINDS.values()
    ]
    return _HEAD + "".join(rows) + _FAMILIES + "".join(_inertial(samples) for samples in (1, 0))


def _inertial(samples: int) -> str:
    """The rows of inertial factors: of any number of samples, or of none."""
    form = inertial.ImuForm(samples)
    name = inertial.NAME if samples else form.name
    rows = [f"| `{name}` | {_MOMENTS} | {form.measured} | {form.residual} |\n"]
    for (mount, gravity), further in _FURTHER.items():
        named = name + inertial.ImuForm(1, mount, gravity).name.removeprefix(inertial.ImuForm(1).name)
        letters = " and ".join(["m"] * mount + ["g"] * gravity)
        rows.append(f"| `{named}` | {_MOMENTS}{further} | that of {name} without {letters} | that of {name} |\n")
    return "".join(rows)


def operations() -> str:
    """A row for each operation; how to read it, and what there is not, is below it."""
    rows = [f"| `{each.signature()}` | {each.forms} | {each.means} |\n" for each in OPERATIONS.values()]
    return f"{_OPERATIONS_HEAD}{''.join(rows)}\n{LEGEND}\n{ABSENT}\n"


def found(text: str, head: str = _HEAD, blocks: int = 1) -> str:
    """The table with this head in the text of the page: up to the next line that is no row; or more blocks."""
    start = end = text.index(head)
    for _ in range(blocks):
        end = text.index("\n\n", end) + 1
    return text[start:end]


def _ends(kind: FactorKind) -> str:
    if kind.base:
        base = FACTOR_KINDS[kind.base]
        further = zip(kind.connects[len(base.connects) :], kind.modifiers, strict=True)
        return ", ".join([_ends(base), *(f"{end} {LETTERS[modifier]}" for end, modifier in further)])
    poses = [VARIABLE_KINDS[end].is_pose for end in kind.connects]
    if len(poses) == 1:
        letters = ["x"]
    elif kind.roles:
        letters = ["f", "v"]
    elif all(poses) or kind.connects[0] == kind.connects[1]:
        letters = ["a", "b"]
    else:
        letters = ["a", "y" if kind.connects[1] == "idp" else "l"]
    return ", ".join(f"{end} {letter}" for end, letter in zip(kind.connects, letters, strict=True))


if __name__ == "__main__":
    main()
