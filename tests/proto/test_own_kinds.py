"""Formulas: what they mean, how they are written, and what is wrong with those that mean nothing."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from naive.own_formulas import OWN
from naive.random_formulas import random_formula

from factorbus.client import Draft
from factorbus.client.expressions import SE2, SE3, Point2, Point3, Vector, factor, norm, select
from factorbus.proto import codec
from factorbus.proto.expressions.declaration import BadExpression
from factorbus.proto.expressions.formula import MOST_CHARACTERS, read_formula, write_formula
from factorbus.proto.expressions.frames import moving_ends
from factorbus.proto.expressions.operations import OPERATIONS, Mismatch, Type
from factorbus.proto.kinds import FACTOR_KINDS, FactorKind, own_kind
from factorbus.proto.messages import Insert
from factorbus.proto.problems import BadShape, Problem, UnknownKind
from factorbus.proto.roles import mounts_of
from factorbus.proto.symbols import symbol

GOOD = "near(a:se3,l:point3,b:vector1,z:1)=subtract(add(norm(act(inverse(a),l)),b),z)"
WIDE, PARTS = (",".join(of) for of in (
    [f"x{n}:vector9" for n in range(16)], [f"part(x{n},0,4)" for n in range(16)]
))  # fmt: skip
SHARED = "seen(a:se2,l:point2,z:2)=_1=act(inverse(a),l);vector(subtract(norm(_1),part(z,0,1)),part(_1,1,1))"


@pytest.mark.parametrize("text", [GOOD, SHARED, *(kind.name for kind in OWN.values())])
def test_a_formula_read_and_written_is_the_same(text: str) -> None:
    declared = read_formula(text)
    assert write_formula(declared) == text
    assert FACTOR_KINDS[text].own == declared
    assert text in FACTOR_KINDS


def test_random_ones_too() -> None:
    for seed in range(200):
        declared = random_formula(np.random.default_rng(seed))
        assert read_formula(write_formula(declared)) == declared


def test_texts_of_one_expression_are_one_kind() -> None:
    spaced = " near ( a : se3 , l : point3, b:vector1,z:1 ) =\n_7=inverse(a);  subtract(add(norm(act(_7,l)), b), z)"
    assert FACTOR_KINDS[spaced].name == GOOD
    twice = "f(a:se2,b:se2,z:1)=subtract(dot(position(a),position(b)),norm(position(a)))"
    assert FACTOR_KINDS[twice].name == "f(a:se2,b:se2,z:1)=_1=position(a);subtract(dot(_1,position(b)),norm(_1))"
    assert FACTOR_KINDS["f(a:vector1,z:1)=a"].name == "f(a:vector1,z:1)=vector(a)"
    assert FACTOR_KINDS["f(a:vector1,z:1)=multiply(a,1.50)"].name == "f(a:vector1,z:1)=multiply(a,1.5)"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("f(", "wanted more of a formula"),
        ("f(a:se2,z:1)", "wanted more of a formula"),
        ("f(a:se2,z:1)=", "wanted more of a formula"),
        ("f(a:se2,z:1)=norm(position(a)", "wanted more of a formula"),
        ("f(a:se2,z:1)=norm(position(a)))", "wanted the end"),
        ("f(a:se2,z:1)=turn(a)", r"⟨here⟩ turn\(a\); wanted a variable, a number, or one of compose, inverse"),
        ("f(a:se2,z:1)=norm(a)", "norm, node 2: got se2, wanted vectors of one size"),
        ("f(a:se2,z:1)=log(a,a)", r"log, node 2: its arguments are \[0, 0\]; wanted 1 of the nodes"),
        ("f(a:se2,z:1)=inverse(a)", "its residual is se2; wanted 1 to 64 numbers"),
        ("f(a:se2,b:se2,z:1)=position(a)", "does not depend on b"),
        ("f(a:se2)=position(a)", "nothing is measured"),
        ("f(z:1)=z", "0 variables; wanted 1 to 16"),
        ("f(a:se2,a:se2,z:1)=position(a)", "a variable is called 'a'; wanted a name of its own"),
        ("f(z:1,a:se2)=position(a)", "z as the last"),
        ("f(a:se5,z:1)=position(a)", "'se5' is no kind of variable of an expression; wanted se2"),
        ("f(a:se2,z:65)=position(a)", "what is measured is 65; wanted so3, se2, se3, or 1 to 64"),
        ("f(a:se2,z:0)=position(a)", "what is measured is 0"),
        ("f(a:se2,z:1)=part(position(a),1,2)", "wanted a vector of at least 3 numbers"),
        ("f(a:se2,z:1)=part(position(a),0.5,1)", "wanted 2 integers"),
        ("f(a:se2,z:1)=part(position(a))", "wanted 2 integers"),
        ("f(a:se2,z:1)=add(position(a),[1,1e999])", "wanted 1 to 64 finite numbers"),
        ("f(a:se2,z:1)=add(position(a),[1,z])", "wanted a number"),
        ("f(a:se2,z:1)=_1=position(a);_1=z;_1", "wanted a name that is not used yet in place of _1"),
        ("f(a:se2,z:1)=_1;_1=position(a)", "wanted a variable, a number"),
        ("F(a:se2,z:1)=position(a)", "⟨here⟩ F.*wanted small letters, digits, _ and"),
        ("f(A:se2,z:1)=position(A)", "⟨here⟩ A.*wanted small letters, digits, _ and"),
        ("f(_1:se2,z:1)=position(_1)", "wanted a name, which begins with a small letter"),
        ("_f(a:se2,z:1)=position(a)", "wanted a name, which begins with a small letter"),
        ("f(a:se2,z:1)=subtract(heading(a),１)", "⟨here⟩ １.*wanted small letters, digits, _ and"),
        ("f(a:se2,z:1)=subtract(heading(a),١)", "⟨here⟩ ١.*wanted small letters, digits, _ and"),
        ("f(a:se2,z:1)=\u2003heading(a)", "wanted small letters, digits, _ and"),
        ("f(a:se2,z:1)=headng(a)", "did you mean 'heading'"),
        ("f(anchor:se2,z:1)=heading(anchr)", "did you mean 'anchor'"),
        ("f(a:pont2,z:1)=norm(a)", "did you mean 'point2'"),
        ("f(a:vector3,z:1)=part(a,-1,1)", "first is -1 and count is 1, wanted first from 0 on and count from 1 on"),
        ("f(a:vector3,z:1)=part(a,0,0)", "first is 0 and count is 0, wanted first from 0 on and count from 1 on"),
        ("prior_se2(a:se2,z:se2)=log(a)", "prior_se2 is a kind that there is already"),
        ("linear_3(a:se2,z:se2)=log(a)", "linear_3 is a kind that there is already"),
        (f"{'n' * 64}(a:se2,z:1)=position(a)", "wanted up to 63 small letters"),
        (f"f(a:vector1,z:1)={'sin(' * 501}a{')' * 501}", "more than 500 nodes"),
        (f"f(a:vector1,z:1)={'add(a,' * 3000}a", "has 18018 characters; wanted at most 16384"),
        (f"f({WIDE},z:1)=vector({PARTS})", "144 scalars"),
    ],
)  # fmt: skip
def test_what_is_no_formula_says_why(text: str, why: str) -> None:
    with pytest.raises(BadExpression, match=why):
        own_kind(read_formula(text))
    assert text not in FACTOR_KINDS
    assert FACTOR_KINDS.get(text) is None
    if "(" in text[:64]:
        assert len(FACTOR_KINDS.names(text)) == 1


def test_ten_thousand_mutated_formulas_are_refused_or_are_kinds() -> None:
    rng = np.random.default_rng(5)
    texts = [GOOD, SHARED, *(kind.name for kind in OWN.values())]
    letters = [
        *"abcxyz01239(),:;=[]_ .-+eE",
        "se2",
        "se3",
        "so3",
        "norm(",
        "vector(",
        "inverse(",
        "part(",
        "1e9",
        "é",
        "\0",
    ]
    good = 0
    for _ in range(10_000):
        text = [*texts[int(rng.integers(len(texts)))]]
        for _ in range(int(rng.integers(1, 4))):
            at, how = int(rng.integers(len(text))), int(rng.integers(4))
            if how == 0:
                del text[at : at + int(rng.integers(1, 6))]
            elif how == 1:
                text.insert(at, str(rng.choice(letters)))
            elif how == 2:
                text[at] = str(rng.choice(letters))
            else:
                other = int(rng.integers(len(text)))
                text[at], text[other] = text[other], text[at]
            text = text or ["f"]
        whole = "".join(text)
        if (kind := _kind_or_reason(whole)) is None:
            continue
        good += 1
        assert FACTOR_KINDS[kind.name] == kind == FACTOR_KINDS[whole]
        assert 1 <= kind.dim <= 64
    assert 100 < good < 5000


def _kind_or_reason(text: str) -> FactorKind | None:
    """None: it is none, and the reason is one that a person can use."""
    try:
        return own_kind(read_formula(text))
    except BadExpression as problem:
        reason = str(problem)
    assert "wanted" in reason, text
    assert len(reason) < 700
    return None


@pytest.mark.parametrize("name", OWN)
def test_mounts_are_found_by_moving_all_else(name: str) -> None:
    usual, own = FACTOR_KINDS[name], OWN[name]
    assert own.each_role == usual.each_role
    assert own.is_absolute == usual.is_absolute
    assert (own.connects, own.size, own.dim) == (usual.connects, usual.size, usual.dim)


def test_what_says_nothing_of_the_frame() -> None:
    assert moving_ends(read_formula("f(a:vector3,b:vector3,z:3)=subtract(subtract(b,a),z)")) == ()
    assert not FACTOR_KINDS["f(a:vector3,b:vector3,z:3)=subtract(subtract(b,a),z)"].is_absolute
    assert FACTOR_KINDS["f(a:se2,z:1)=subtract(heading(a),z)"].is_absolute
    keys = np.array([[symbol("y", 1), symbol("p", 1), symbol("m", 0)]])
    draft = Draft().factor(OWN["landmark_se3_mount"], keys[0].tolist(), (0, 0, 1), sigmas=(1, 1, 1))
    assert mounts_of(draft.batch()).tolist() == [symbol("m", 0)]


@factor
def clock(a: SE3, l: Point3, c: Vector[2], z: Vector[1]):
    seen = norm(l - a.position)
    return select(z - 1.0, (1 + c[0]) * seen + c[1] - z, 2 * seen / 4)


def test_a_function_is_a_formula() -> None:
    assert clock.called == "clock"
    assert (clock.connects, clock.size, clock.dim) == (("se3", "point3", "vector2"), 1, 1)
    assert read_formula(clock.name) == clock.own
    batch = Draft().factor(clock, ("x1", "l2", "c0"), [2.5], sigmas=[0.5], loss=("huber", 1.5)).batch()
    assert batch.factors[0].kind == clock.name
    back = codec.decode_insert(codec.encode_insert(Insert(1, batch)))
    assert back.batch.factors[0].kind == clock.name
    with pytest.raises(BadShape, match=r"clock x1 l2: keys"):
        Draft().factor(clock, ("x1", "l2"), [2.5])


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("a + l", "add: got se3 and a vector of 3, wanted vectors of one size"),
        ("a.rotate(3)", "rotate: got se3 and a number, wanted"),
        ("norm(a)", "norm: got se3, wanted"),
        ("5", "f: it returned 5; wanted an expression"),
        ("[]", r"f: it returned \[\]; wanted"),
        ("l + 'x'", "got 'x'; wanted an expression, a number, or a list"),
        ("l[5]", "5 of a vector of 3; wanted one number"),
        ("norm(l)", "does not depend on a"),
    ],
)
def test_a_function_that_is_no_formula_says_why(body: str, why: str) -> None:
    names = {"SE3": SE3, "Point3": Point3, "Vector": Vector, "norm": norm}
    exec(f"def f(a: SE3, l: Point3, z: Vector[1]):\n    return {body}\n", names)
    with pytest.raises((BadExpression, IndexError), match=why):
        factor(names["f"])


def test_python_cannot_decide_by_an_expression() -> None:
    def f(a: SE2, z: Vector[1]):
        return a.position if a.heading else z

    with pytest.raises(BadExpression, match=r"no value while it is written; wanted select\(a - b, x, y\)") as refused:
        factor(f)
    assert isinstance(refused.value, Problem)
    assert refused.value.code == "unknown_kind"


# What is written first, and the way to write it that the refusal has; a is an se2, p a point2, v a vector3.
FIRST_TRIED = {
    "a.heading > 0": r">: .*wanted select",
    "0 > a.heading": r"<: .*wanted select",
    "a.heading >= 0": r">=: .*wanted select",
    "a.heading <= 0": r"<=: .*wanted select",
    "a.heading == 0": r"==: .*wanted select",
    "a.heading != 0": r"!=: .*wanted select",
    "max(a.heading, 0)": r"wanted select",
    "norm(p) ** 2": r"\*\*: .*wanted a \* a, sqrt\(a\), or dot",
    "2 ** norm(p)": r"\*\*: .*no power of a number",
    "abs(norm(p))": r"abs: .*wanted norm\(a\)",
    "p @ p": r"@: .*wanted dot\(a, b\) of vectors",
    "np.eye(2) @ p": r"matmul: .*wanted dot\(a, b\) of vectors",
    "a.heading % 6.28": r"%: .*wanted wrap",
    "a.heading // 2": r"//: .*wanted a / b",
    "round(a.heading)": r"round: ",
    "int(a.heading)": r"int: ",
    "[1, 2][a.heading]": r"as an index .*wanted a fixed number",
    "math.sin(a.heading)": r"function of math: .*wanted sin, cos",
    "np.sin(a.heading)": r"np\.sin: .*wanted sin\(a\)",
    "np.arctan2(p[1], p[0])": r"np\.arctan2: .*wanted atan2\(a, b\)",
    "np.log(norm(p))": r"np\.log: .*no such function.*no power, logarithm",
    "np.linalg.norm(p)": r"np\.norm: .*wanted norm\(a\)",
    "np.dot(p, p)": r"np\.dot: .*wanted dot",
    "np.hypot(p[0], p[1])": r"np\.hypot: .*wanted norm\(vector",
    "np.array([p[0], p[1]])": r"as an array of NumPy: .*vector",
    "np.cosh(a.heading)": r"np\.cosh: .*did you mean 'cos'",
    "np.ones(2) > p": r"np\.\w+: .*wanted select",
    "a.theta": r"se2 has no \.theta; wanted \.heading",
    "a.x": r"has no \.x; wanted \.position\[0\]",
    "v.z": r"has no \.z; wanted .*\[2\] of a vector",
    "a.translation": r"wanted \.position",
    "a.norm()": r"wanted norm\(a\), a function",
    "a.T": r"wanted \.inverse\(\)",
    "a.heding": r"wanted \.position, .*did you mean '\.heading'",
    "v.heading": r"heading: got a vector of 3, wanted a pose in the plane",
    "a.position()": r"\(\): .*without parentheses",
    "norm(p) * '3'": r"got '3'; wanted an expression, a number",
    "'3' * norm(p)": r"got '3'; wanted an expression, a number",
    "p * ['3', '4']": r"got \['3', '4'\]; wanted",
    "norm([p[0], p[1]])": r"norm: got a list with expressions.*wanted vector\(a, b\)",
}


@pytest.mark.parametrize("body", FIRST_TRIED)
def test_what_is_tried_first_says_how_it_is_written(body: str) -> None:
    names = {"SE2": SE2, "Point2": Point2, "Vector": Vector, "norm": norm, "np": np, "math": math}
    exec(f"def f(a: SE2, p: Point2, v: Vector[3], z: Vector[1]):\n    return {body}\n", names)
    with pytest.raises(BadExpression, match=FIRST_TRIED[body]):
        factor(names["f"])


def test_numpy_has_numbers_beside_expressions() -> None:
    @factor
    def f(p: Point2, z: Vector[2]):
        assert not hasattr(p, "foot")
        return np.array([1.0, 2.0]) * p + np.float64(3.0) * p - np.ones(2) - z

    @factor
    def g(p: Point2, z: Vector[2]):
        return [1.0, 2.0] * p + 3.0 * +p - [1.0, 1.0] - z

    assert f.name.removeprefix("f") == g.name.removeprefix("g")


def plain(a: SE2, z: Vector[1]):
    return a.heading - z


@pytest.mark.parametrize(
    ("made", "why"),
    [
        (lambda: factor(), "factor: got nothing; wanted @factor without parentheses"),
        (lambda: factor(name="g"), "factor: got name; wanted @factor without parentheses"),
        (lambda: factor(plain, name="g"), "factor: got name; .*its name is that of the kind"),
        (lambda: factor("f(a:se2,z:1)=heading(a)"), "factor: got 'f"),  # type: ignore[arg-type]
    ],
)
def test_the_decorator_stands_alone(made: Callable[[], object], why: str) -> None:
    with pytest.raises(BadExpression, match=why):
        made()


def test_a_parameter_is_a_variable_and_has_no_default() -> None:
    def three(a: SE2, z: Vector[1] = 3):  # type: ignore[assignment]
        return a.heading - z

    def many(*a: SE2, z: Vector[1]):
        return a[0].heading - z

    with pytest.raises(BadExpression, match="three: z has the default 3, which no factor would have"):
        factor(three)
    with pytest.raises(BadExpression, match=r"many: \*a.*one parameter for each variable"):
        factor(many)


def test_an_own_kind_cannot_be_found_by_its_short_name() -> None:
    for kind in ("clock", "clokc", "range_bias"):
        with pytest.raises(
            UnknownKind, match="or a formula; one of your own is given as what @factor made of its function"
        ):
            Draft().factor(kind, ("x1",), [1.0], sigmas=[1.0])
    with pytest.raises(UnknownKind, match="did you mean 'range_se2'"):
        Draft().factor("rnage_se2", ("x1", "l1"), [1.0], sigmas=[1.0])
    with pytest.raises(UnknownKind) as refused:
        Draft().factor("f(a:se2,z:1)=headng(a)", ("x1",), [1.0], sigmas=[1.0])
    assert str(refused.value).count("did you mean") == 1


TYPES: tuple[Type, ...] = ("so3", "se2", "se3", 1, 2, 3, 4, 6, 64)


def test_the_table_of_signatures_has_what_each_operation_takes() -> None:
    """By a reading of the table that is not the checker's: every case of up to three arguments."""
    for each in OPERATIONS.values():
        if each.name in ("part", "vector"):
            continue
        table = {}
        for form in each.forms.split("; "):
            takes, gives = form.split(" → ")
            for n, group in itertools.product((1, 2, 3, 4, 6, 64), ("so3", "se2", "se3")):
                meant = {"n": n, "G": group} | {str(k): k for k in range(1, 7)}
                table[tuple(meant.get(word, word) for word in takes.split(", "))] = meant.get(gives, gives)
        assert each.signature().count(",") == each.arguments - 1
        for given in itertools.product(TYPES, repeat=each.arguments):
            if given in table:
                assert each.gives(given, ()) == table[given]
            else:
                with pytest.raises(Mismatch, match=r"got .*, wanted "):
                    each.gives(given, ())
    with pytest.raises(Mismatch, match="at most 64 numbers together"):
        OPERATIONS["vector"].gives((64, 1), ())
    assert OPERATIONS["part"].gives((3,), (1, 2)) == 2


def test_an_annotation_that_is_no_kind_says_so() -> None:
    def f(a: float, z: Vector[1]):
        return z

    with pytest.raises(BadExpression, match=r"a is annotated <class 'float'>; wanted SE2, SE3"):
        factor(f)


def test_a_message_with_a_bad_formula_is_refused_with_the_place() -> None:
    batch = Draft().factor(FACTOR_KINDS[GOOD], ("x1", "l2", "c0"), [2.5], sigmas=[0.5]).batch()
    bad = GOOD.replace("norm", "nrm")
    message = codec.encode_insert(Insert(1, batch)).replace(GOOD.encode(), bad.encode() + b" ")
    assert len(bad) + 1 == len(GOOD)
    with pytest.raises(UnknownKind, match=r"factors\[0\].kind.*⟨here⟩ nrm\(act"):
        codec.decode_insert(message)
    assert issubclass(UnknownKind, Problem)
    assert MOST_CHARACTERS < 1 << 15


@pytest.mark.parametrize("called", ["pose", "position", "norm", "act", "subtract", "log"])
def test_a_variable_may_be_called_as_an_operation_is(called: str) -> None:
    text = f"f({called}:se2,l:point2,z:1)=subtract(norm(subtract(position({called}),l)),z)"
    plain = read_formula(text.replace(f"({called}:", "(a:").replace(f"position({called})", "position(a)"))
    read = read_formula(text)
    assert read.nodes == plain.nodes
    assert read.variables == ((called, "se2"), ("l", "point2"))
    with pytest.raises(BadExpression, match=r'wanted "\("'):
        read_formula("f(a:se2,z:1)=subtract(norm,z)")
