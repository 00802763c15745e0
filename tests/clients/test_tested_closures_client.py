"""What a front end says of loop closures that a map tests: trusted factors, overrides, merges; older services."""

import numpy as np
import pytest

from factorbus.client import Changes, Draft
from factorbus.client.merging import as_trusted
from factorbus.client.supported import check_suspects, check_trusted
from factorbus.proto import codec
from factorbus.proto.messages import Insert
from factorbus.proto.problems import BadOption, BadShape, NotSupported
from factorbus.proto.protocol import known

SIGMAS = (0.1, 0.1, 0.02)


def test_trusted_factors_are_a_group_of_their_own_and_travel() -> None:
    draft = Draft().between_se2("x0", "x5", (1, 0, 0), sigmas=SIGMAS)
    draft.between_se2("x0", "x6", (1, 0, 0), sigmas=SIGMAS, trusted=True)
    batch = draft.batch()
    assert [group.trusted for group in batch.factors] == [False, True]
    again = codec.decode_insert(codec.encode_insert(Insert(1, batch))).batch
    assert [group.trusted for group in again.factors] == [False, True]
    assert again.factors[1].keys.tolist() == batch.factors[1].keys.tolist()


@pytest.mark.parametrize("mount", [(0.5, 0.0, 0.1), None])
def test_with_a_mount_it_is_trusted_too(mount: tuple[float, float, float] | None) -> None:
    draft = Draft().between_se2("x0", "x6", (1, 0, 0), sigmas=SIGMAS, trusted=True, mount=mount)
    assert [group.trusted for group in draft.batch().factors] == [True]


def test_what_is_no_flag_is_refused() -> None:
    with pytest.raises(BadOption, match="trusted"):
        Draft().between_se2("x0", "x6", (1, 0, 0), sigmas=SIGMAS, trusted=1)  # type: ignore[typeddict-item]


def test_overrides_name_factors() -> None:
    accept, reject = Changes().accept([4, 17]).reject(3).listed()
    assert (accept.change, accept.factors.tolist()) == ("accept", [4, 17])  # type: ignore[union-attr]
    assert (reject.change, reject.factors.tolist()) == ("reject", [3])  # type: ignore[union-attr]
    for none in (Changes().accept, Changes().reject):
        with pytest.raises(BadShape):
            none([])


def test_a_merge_is_trusted_whole() -> None:
    batch = Draft().se2("x0").between_se2("x0", "x6", (1, 0, 0), sigmas=SIGMAS).batch()
    made = as_trusted(batch)
    assert [group.trusted for group in made.factors] == [True]
    np.testing.assert_array_equal(made.factors[0].measured, batch.factors[0].measured)
    assert made.variables == batch.variables


def test_an_older_service_is_not_sent_what_it_would_skip() -> None:
    older = {name: value for name, value in known().items() if name != "factor_fields"} | {"questions": ["estimate"]}
    trusted = Draft().between_se2("x0", "x6", (1, 0, 0), sigmas=SIGMAS, trusted=True).batch()
    plain = Draft().between_se2("x0", "x6", (1, 0, 0), sigmas=SIGMAS).batch()
    with pytest.raises(NotSupported, match="trusted factors"):
        check_trusted(older, trusted)
    with pytest.raises(NotSupported, match="tests its loop closures"):
        check_suspects(older)
    check_trusted(older, plain)
    check_trusted(known(), trusted)
    check_suspects(known())
