"""A kind of one's own says nothing of the frame of the map where that is proven, and not where it looks so."""

import time

import numpy as np
import pytest
from naive.moved_formulas import ends_of, stays
from naive.own_formulas import OWN
from naive.random_formulas import random_formula

from factorbus.proto.expressions.exact import ExactArithmetic
from factorbus.proto.expressions.formula import read_formula, write_formula
from factorbus.proto.expressions.frames import moving_ends
from factorbus.proto.kinds import FACTOR_KINDS

ABSOLUTE = {
    "a branch that is seldom taken": "wall(b:se2,z:1)="
    "_1=subtract(part(position(b),0,1),50);subtract(select(_1,_1,0),z)",
    "a branch on z": "mode(p:se2,z:2)="
    "multiply(select(subtract(part(z,0,1),10),1,0),subtract(part(position(p),0,1),part(z,1,1)))",
    "small units": "lat(a:se2,z:1)=subtract(multiply(part(position(a),0,1),1e-9),z)",
    "no number almost everywhere": "height(p:point2,z:1)=subtract(sqrt(subtract(0.01,dot(p,p))),z)",
    "no number in some places": "inside(p:point2,z:1)=subtract(multiply(0,sqrt(subtract(0.01,dot(p,p)))),z)",
    "divided by a place": "over(p:point2,z:1)=subtract(multiply(0,divide(1,dot(p,p))),z)",
    "an angle without wrap": "turn(a:se2,b:se2,z:1)=subtract(subtract(heading(b),heading(a)),z)",
    "the anchor of a feature": "anchor(f:idp,z:1)=subtract(part(f,2,1),z)",
    "the direction of a feature": "ray(f:idp,a:se3,z:1)=multiply(subtract(part(f,3,1),z),norm(position(a)))",
    "half an angle": "half(a:se2,b:se2,z:1)=wrap(subtract(add(heading(a),heading(b)),multiply(1.5,heading(b))))",
    "divided by nothing": "nothing(a:se2,b:se2,z:1)="
    "add(norm(subtract(position(a),position(b))),multiply(z,divide(1,subtract(z,z))))",
}
RELATIVE = {
    "headings": "f(a:se2,b:se2,z:1)=wrap(subtract(subtract(heading(b),heading(a)),z))",
    "a bearing by atan2": "f(a:se2,l:point2,z:1)=_1=subtract(l,position(a));"
    "wrap(subtract(subtract(atan2(part(_1,1,1),part(_1,0,1)),heading(a)),z))",
    "an angle between rotations": "f(a:se3,b:se3,z:1)=subtract(norm(log(compose(rotation(a),inverse(rotation(b))))),z)",
    "a rotation by hand": "f(a:se2,b:se2,z:1)=_1=heading(a);_2=subtract(position(b),position(a));"
    "subtract(add(multiply(cos(_1),part(_2,0,1)),multiply(sin(_1),part(_2,1,1))),z)",
    "a distance by hand": "f(a:se2,b:se2,z:1)=_1=subtract(position(b),position(a));"
    "_2=part(_1,0,1);_3=part(_1,1,1);subtract(sqrt(add(multiply(_2,_2),multiply(_3,_3))),z)",
    "a volume": "f(a:point3,b:point3,c:point3,z:1)=_1=subtract(a,b);"
    "subtract(dot(_1,cross(subtract(b,c),subtract(a,c))),z)",
    "from the middle of two": "f(a:se2,b:se2,l:point2,z:1)="
    "subtract(norm(subtract(l,multiply(0.5,add(position(a),position(b))))),z)",
    "twice a heading": "f(a:se2,b:se2,c:se2,z:1)="
    "wrap(subtract(subtract(add(heading(a),heading(b)),multiply(2,heading(c))),z))",
    "a pose put together": "f(a:se2,b:se2,z:se2)="
    "log(compose(inverse(z),compose(inverse(pose(position(a),heading(a))),b)))",
    "a direction both see": "f(a:se3,b:se3,z:6)=subtract(rotate(inverse(rotation(a)),rotate(rotation(b),part(z,0,3))),"
    "part(z,3,3))",
    "a rotation about what is between": "f(a:se3,b:se3,z:3)="
    "subtract(rotate(inverse(rotation(a)),log(exp(subtract(position(b),position(a))))),z)",
    "only where it is near": "f(a:se2,b:se2,z:1)=_1=norm(subtract(position(b),position(a)));"
    "select(subtract(1,_1),subtract(_1,z),0)",
    "how far a feature is": "f(f:idp,a:se3,z:2)="
    "subtract(vector(norm(subtract(part(f,0,3),position(a))),part(f,5,1)),z)",
}


@pytest.mark.parametrize("text", ABSOLUTE.values(), ids=ABSOLUTE)
def test_what_is_not_proven_says_where_its_variables_are(text: str) -> None:
    assert moving_ends(read_formula(text)) is None
    assert FACTOR_KINDS[text].is_absolute
    assert set(FACTOR_KINDS[text].each_role) == {""}


@pytest.mark.parametrize("text", RELATIVE.values(), ids=RELATIVE)
def test_what_holds_of_any_motion_is_proven(text: str) -> None:
    declared = read_formula(text)
    assert moving_ends(declared) == ends_of(declared)
    assert not FACTOR_KINDS[text].is_absolute


@pytest.mark.parametrize("name", OWN)
def test_so_it_is_of_kinds_with_a_mount(name: str) -> None:
    assert moving_ends(OWN[name].own) == (None if name.startswith("prior") else (0, 1))
    assert OWN[name].each_role == FACTOR_KINDS[name].each_role


def test_what_is_proven_is_seen_when_the_map_is_moved() -> None:
    """And what is always seen is proven, but for features that stay where they are, and what a root is positive for."""
    proven, not_proven = 0, list[str]()
    for nodes in (3, 6, 12):
        for seed in range(300):
            declared = random_formula(np.random.default_rng(seed), nodes)
            if not (ends := ends_of(declared)):
                continue
            if (moving := moving_ends(declared)) is not None:
                assert False not in [stays(declared, moving, k) for k in range(5)], write_formula(declared)
                proven += 1
            elif "idp" not in [kind for _, kind in declared.variables]:
                ways = [tuple(n for n in ends if n != left) for left in (-1, *ends[: len(ends) - 1])]
                if any({stays(declared, way, k) for k in range(5)} == {True} for way in ways):
                    not_proven.append(write_formula(declared))
    assert proven > 20
    assert not_proven == []


def test_two_of_a_few_may_stay_on_the_robot_and_one_of_many() -> None:
    chain = "norm(subtract(position(compose(a,m)),position(compose(b,n))))"
    assert moving_ends(read_formula(f"f(a:se2,b:se2,m:se2,n:se2,z:1)=subtract({chain},z)")) == (0, 1)
    more = "".join(f",l{k}:point2" for k in range(5))
    sums = "".join(f"add(norm(subtract(l{k},position(a)))," for k in range(5)) + chain + ")" * 5
    assert moving_ends(read_formula(f"f(a:se2,b:se2,m:se2,n:se2{more},z:1)=subtract({sums},z)")) is None


def test_each_formula_has_a_prime_of_its_own() -> None:
    """Else 2⁶³ · 2⁶⁴ − 1, or whatever it were, is 0 there and not where factors are computed."""
    first, second = (ExactArithmetic(read_formula(text)).prime for text in list(RELATIVE.values())[:2])
    assert first != second
    for prime in (first, second):
        assert pow(3, prime - 1, prime) == 1
        assert prime.bit_length() == 128
        assert prime % 4 == 3


def test_the_largest_formula_is_decided_in_a_fraction_of_a_second() -> None:
    poses = ",".join(f"x{n}:se3" for n in range(16))
    steps = "_1=compose(x0,x1);" + "".join(f"_{n}=compose(_{n - 1},x{n % 16});" for n in range(2, 120))
    declared = read_formula(f"f({poses},z:se3)={steps}log(compose(inverse(z),_119))")
    before = time.process_time()
    assert moving_ends(declared) is None
    assert time.process_time() - before < 2.0
