"""What the rows of a draft are, and they as the columns of an insert."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias, TypedDict

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.stamps import NO_STAMP

# By (kind, whether they come with values, whether they are fixed): keys, values, stamps.
VariableRows: TypeAlias = dict[tuple[str, bool, bool], tuple[list[int], list[F64], list[int]]]
# By (kind, loss): keys, measurements, upper triangles of the information, scales of the loss.
FactorRows: TypeAlias = dict[tuple[str, str], tuple[list[list[int]], list[F64], list[F64], list[float]]]


class Held(TypedDict, total=False):
    """What may be said of a variable besides its value: see `Draft`."""

    fixed: bool
    stamp: int | None


def batch_of_columns(variables: VariableRows, factors: FactorRows, further: Sequence[Factors]) -> Batch:
    """All of them; `further`: factors that are columns already."""
    return Batch(
        tuple(
            Variables(
                kind,
                np.array(keys, np.int64),
                np.array(rows) if valued else None,
                fixed,
                np.array(stamps, np.int64) if any(stamp != NO_STAMP for stamp in stamps) else None,
            )
            for (kind, valued, fixed), (keys, rows, stamps) in variables.items()
        ),
        (
            *(
                Factors(
                    kind,
                    np.array(keys, np.int64),
                    np.array(measured),
                    np.array(information),
                    loss,
                    np.array(scales) if loss else None,
                )
                for (kind, loss), (keys, measured, information, scales) in factors.items()
            ),
            *further,
        ),
    )
