"""When a closure is believed, and how much of it all is looked at in one step."""

from dataclasses import dataclass

from factorbus.solver.errors import BadOption
from factorbus.solver.option_ranges import check_within

_SHARES = (
    "closure_gate_probability", "closure_out_probability", "closure_chance_max",
    "closure_sets_max",
)  # fmt: skip
_SURE = 1e-12  # from 0 and 1: where quantiles of χ² are numbers that can be computed with


@dataclass(frozen=True, slots=True)
class ClosurePolicy:
    """How closures are tested.  Shares and probabilities are numbers between 0 and 1.

    closure_gate_probability   a right closure is within the gate with this probability
    closure_out_probability    the same for one that the map has, or that agrees with others: beyond, it is improbable
    closure_chance_max         a closure is believed by itself where the odds that it is false are at most this; and a
                               set of them where as many false sets at these places are expected
    closure_sets_max           sets like one that is believed, expected among independent false closures, at most
    closure_spread_m, closure_spread_rad   false closures are off by up to this along each axis, and about each
    closure_place_m            closures whose ends are within this of each other, metres, are of the same two places:
                               they are one mistake, if they are one
    closure_revisits           suspects that are looked at again in a step with a new closure, at most
    closure_retests            accepted closures that are looked at again in such a step, at most

    Raises BadOption.
    """

    closure_gate_probability: float = 0.999
    closure_out_probability: float = 1.0 - 1e-6
    closure_chance_max: float = 0.02
    closure_sets_max: float = 1e-3
    closure_spread_m: float = 5.0
    closure_spread_rad: float = 0.5
    closure_place_m: float = 10.0
    closure_revisits: int = 16
    closure_retests: int = 256

    def __post_init__(self) -> None:
        for name in _SHARES:
            check_within(name, getattr(self, name), _SURE, 1.0 - _SURE)
        for name in ("closure_spread_m", "closure_spread_rad", "closure_place_m"):
            check_within(name, getattr(self, name), 1e-6, 1e6)
        for name in ("closure_revisits", "closure_retests"):
            check_within(name, getattr(self, name), 0, 10_000, whole=True)
        if self.closure_out_probability < self.closure_gate_probability:
            seen = f"{self.closure_out_probability:g} < {self.closure_gate_probability:g}"
            raise BadOption("closure_out_probability", seen, "closure_gate_probability or more")
