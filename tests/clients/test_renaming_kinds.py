"""Own kinds of a map under other names, and what is said where a merge needs them."""

import numpy as np
import pytest

from factorbus.client import CannotMerge, Draft, rename_kinds
from factorbus.client.merging import fit_into
from factorbus.client.renaming_kinds import saying_how_to_rename
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Estimate, MapGraph, Variables
from factorbus.proto.problems import BadOption, Refused

WHEEL = "wheel(a:se2,b:se2,z:1)=_1=position(compose(inverse(a),b));subtract(norm(_1),multiply(z,dot(_1,_1)))"
OTHER = "slip(a:se2,b:se2,z:1)=subtract(norm(subtract(position(a),position(b))),z)"


def graph() -> MapGraph:
    draft = Draft().se2("x0", (0, 0, 0)).se2("x1", (1, 0, 0)).between_se2("x0", "x1", (1, 0, 0), sigmas=[1] * 3)
    for kind, loss in ((WHEEL, None), (OTHER, None), (WHEEL, "huber")):
        draft.factor(kind, ("x0", "x1"), [1.5], sigmas=[0.5], loss=loss)
    return MapGraph(9, 4, draft.batch())


def test_a_kind_has_another_name_and_is_the_same() -> None:
    before, after = graph(), rename_kinds(graph(), {"wheel": "wheel_of_hall"})
    assert (after.epoch, after.revision, after.batch.variables[0].keys.tolist()) == (
        9,
        4,
        before.batch.variables[0].keys.tolist(),
    )
    kinds = [group.kind for group in after.batch.factors]
    assert kinds == [group.kind.replace("wheel(", "wheel_of_hall(") for group in before.batch.factors]
    assert sum(kind.startswith("wheel_of_hall(") for kind in kinds) == 2
    for one, other in zip(before.batch.factors, after.batch.factors, strict=True):
        assert (other.keys.tolist(), other.measured.tolist()) == (one.keys.tolist(), one.measured.tolist())
        assert (other.information.tolist(), other.loss) == (one.information.tolist(), one.loss)
    swapped = rename_kinds(graph(), {"wheel": "slip", "slip": "wheel"})
    assert FACTOR_KINDS[swapped.batch.factors[1].kind].called == "slip"
    assert rename_kinds(before, {}).batch.factors == before.batch.factors


@pytest.mark.parametrize(
    ("names", "why"),
    [
        ({"whel": "x"}, "'whel', of which the map has no factors; wanted one of slip, wheel; did you mean 'wheel'"),
        ({"between_se2": "x"}, "of which the map has no factors"),
        ({"wheel": "between_se2"}, "between_se2 is a kind that there is already"),
        ({"wheel": "Wheel"}, "small letters, digits and _, a letter first"),
        (["wheel"], "a mapping of names"),
    ],
)
def test_what_is_no_name_is_refused(names: dict[str, str], why: str) -> None:
    with pytest.raises(BadOption, match=why):
        rename_kinds(graph(), names)


def test_a_merge_that_is_refused_for_a_name_says_how_to_rename() -> None:
    told = "wheel is ... in this map, and is ... now; wanted another name for another kind"
    with (
        pytest.raises(
            Refused, match=r"now; nothing was merged\. .*rename_kinds\(other\.graph\(\), {'wheel': 'w"
        ) as refused,
        saying_how_to_rename(),
    ):
        raise Refused("kind_taken", told, {"kind": "wheel"})
    assert (refused.value.code, refused.value.detail["kind"]) == ("kind_taken", "wheel")
    with pytest.raises(Refused, match=r"^too much \[too_large\]$"), saying_how_to_rename():
        raise Refused("too_large", "too much", {})


def test_vectors_alone_have_no_frame_and_are_inserted_as_they_are() -> None:
    vectors = MapGraph(1, 1, Draft().vector("b0", (1, 2)).batch())
    here = Estimate(7, 1, (Variables("se2", np.array([1]), np.zeros((1, 3))),))
    with pytest.raises(
        CannotMerge, match=r"has vector2 alone, which have no frame .*insert its graph\(\)\.batch as it is"
    ):
        fit_into(here, vectors, frame=(0, 0, 0), sigmas=(1, 1, 1))
