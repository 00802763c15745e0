"""The modes of solving: how far a step of each goes.  MATH §8."""

from dataclasses import dataclass

from factorbus.solver.errors import UnknownMode


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode.

    updates      R and d follow Λ and η by updates; else every step that solves factorizes anew
    batch_every  new variables after which the whole system is solved anew, and only then is the linearization point
                 moved: between batches the estimate is that of the linear problem; 0: whenever a step needs it
    tree         the tree of cliques, MATH §9
    """

    name: str
    updates: bool
    batch_every: int = 0
    tree: bool = False


MODE_OF_NAME = {
    mode.name: mode
    for mode in (
        Mode("inc-l", updates=True),
        Mode("inc-l-b10", updates=True, batch_every=10),
        Mode("inc-l-b100", updates=True, batch_every=100),
        Mode("all-batch", updates=False),
        Mode("bayes-tree", updates=True, tree=True),
    )
}
AUTO = "bayes-tree"
MODES = ("auto", *MODE_OF_NAME)


def mode_named(name: str) -> Mode:
    """The mode of this name; "inc-l b10", as in the paper, is "inc-l-b10".  Raises UnknownMode."""
    wanted = AUTO if name == "auto" else str(name).replace(" ", "-")
    if wanted not in MODE_OF_NAME:
        raise UnknownMode(name, MODES)
    return MODE_OF_NAME[wanted]
