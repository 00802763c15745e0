"""What a question would take is known, and refused with its limit, before anything is allocated for it."""

import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from factorbus.proto import asking_codec, codec
from factorbus.proto.asking import AskAssociate, AskCovariance, AskGain, AskGate, AskRepair, AskWhy
from factorbus.proto.expressions.formula import read_formula
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.problems import Problem, TooLarge
from factorbus.proto.repair_codec import encode_ask_repair
from factorbus.service.process.memory import MemoryLimit, OutOfMemory
from factorbus.service.questions import costs
from factorbus.service.questions.answers import QuestionCopies, answer, parse, snapshot
from factorbus.service.questions.question_memory import Room
from factorbus.service.questions.uncertainty import Uncertain
from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.source import CovarianceSource
from factorbus.solver.formulas.own_code import own_code_of
from factorbus.solver.graph.own_kinds import bytes_to_compile

POSES = 400
INFORMATION = np.array([100.0, 0, 0, 100, 0, 400])
EDGE = Factors("between_se2", np.array([[0, 1]]), np.zeros((1, 3)), INFORMATION[None])
SEEN = Factors("landmark_se2", np.array([[0, 1]]), np.zeros((1, 2)), np.array([[1.0, 0, 1.0]]))
ASKED: dict[str, tuple[str, bytes]] = {
    "estimate": ("estimate", b""),
    "graph": ("graph", b""),
    "export": ("export", b""),
    "diagonal": ("covariance", b""),
    "joint": ("covariance", asking_codec.encode_ask_covariance(AskCovariance("joint", np.arange(300)))),
    "cross": ("covariance", asking_codec.encode_ask_covariance(AskCovariance("cross", np.arange(9), np.arange(400)))),
    "relative": (
        "covariance",
        asking_codec.encode_ask_covariance(AskCovariance("relative", np.stack([np.arange(399), np.arange(1, 400)], 1))),
    ),
    "gate": ("gate", asking_codec.encode_ask_gate(AskGate((EDGE,) * 40))),
    "gain": ("gain", asking_codec.encode_ask_gain(AskGain((EDGE,) * 40))),
    "why": ("why", asking_codec.encode_ask_why(AskWhy(key=5))),
    "repair": ("repair", encode_ask_repair(AskRepair())),
}


@pytest.fixture(scope="module", params=["bayes-tree", "all-batch"])
def solver(request: pytest.FixtureRequest) -> Solver:
    keys = np.arange(POSES)
    ends = np.column_stack([keys[:-1], keys[1:]])
    made = Solver(Options(mode=request.param))
    made.stage(
        Batch(
            (Variables("se2", keys[:1], np.zeros((1, 3)), fixed=True), Variables("se2", keys[1:])),
            (
                Factors(
                    "between_se2", ends, np.tile([1.0, 0, 0.01], (len(ends), 1)), np.tile(INFORMATION, (len(ends), 1))
                ),
            ),
        )
    )
    made.step()
    return made


@pytest.fixture
def memory() -> MemoryLimit:
    return MemoryLimit(0)


def take(solver: Solver, name: str, payload: bytes, room: Room) -> tuple[bytes, QuestionCopies]:
    question = parse(name, payload)
    taken = snapshot(solver, 7, 1, [question], {}, None, room)
    return answer(question, taken), taken


def refused(solver: Solver, name: str, payload: bytes, room: Room) -> Problem:
    with pytest.raises(Problem) as caught:
        take(solver, name, payload, room)
    return caught.value


def ask_joint(keys: np.ndarray) -> bytes:
    return asking_codec.encode_ask_covariance(AskCovariance("joint", keys))


@pytest.mark.parametrize("asked", ASKED)
def test_what_no_client_could_receive_is_refused_with_the_limit(solver: Solver, asked: str) -> None:
    name, payload = ASKED[asked]
    message, _ = take(solver, name, payload, Room())
    short = Room(answer_bytes=len(message) // 2)
    problem = refused(solver, name, payload, short)
    assert isinstance(problem, TooLarge)
    assert problem.detail["size"] > problem.detail["limit"] == short.answer_bytes
    assert timeless(take(solver, name, payload, Room(answer_bytes=3 * len(message)))[0]) == timeless(message)


def timeless(message: bytes) -> dict[str, Any]:
    """Without how long it took, which the answer to repair says."""
    return {name: value for name, value in codec.decode_map(message).items() if name != "seconds"}


@pytest.mark.parametrize("asked", sorted(set(ASKED) - {"why"}))
def test_what_there_is_no_memory_for_is_refused_with_the_limit(
    solver: Solver, asked: str, memory: MemoryLimit, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, payload = ASKED[asked]
    monkeypatch.setattr("factorbus.service.questions.question_memory._LITTLE", 0)
    memory.limit = 64 << 10  # what this process has is above it, and a quarter of it is 16 KiB
    problem = refused(solver, name, payload, Room(memory))
    assert isinstance(problem, OutOfMemory)
    assert problem.code == "out_of_memory"
    assert problem.detail["limit"] == 64 << 10
    assert problem.detail["size"] > memory.resident
    assert "memory_bytes" in problem.message
    memory.limit = 1 << 40
    take(solver, name, payload, Room(memory))
    memory.reserve(int(memory.limit - memory.resident - (1 << 20)))  # nothing was kept of what was reserved


@pytest.mark.parametrize("count", [3000, 30_000, 1_000_000])
def test_many_keys_are_refused_before_r_is_copied(solver: Solver, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Known ones or not, a key given again and again among them."""
    monkeypatch.setattr(CovarianceSource, "factoring", lambda _: pytest.fail("R was copied"))
    for keys in (np.arange(count), np.zeros(count, np.int64)):
        problem = refused(solver, "covariance", ask_joint(keys), Room(answer_bytes=64 << 20))
        assert (problem.code, problem.detail["limit"]) == ("too_large", 64 << 20)
        assert problem.detail["size"] >= 8 * (min(kind.dim for kind in VARIABLE_KINDS.values()) * count) ** 2


def test_keys_that_are_given_again_count_again(solver: Solver) -> None:
    keys = np.zeros(500, np.int64)
    assert refused(solver, "covariance", ask_joint(keys), Room(answer_bytes=10 << 20)).code == "too_large"
    found = asking_codec.decode_covariances(take(solver, "covariance", ask_joint(np.array([5, 5])), Room())[0])
    assert found.covariance is not None
    np.testing.assert_array_equal(found.covariance[:3, :3], found.covariance[3:, :3])


def test_a_few_rows_between_many_columns_are_no_square(solver: Solver) -> None:
    """Between one variable and all: what is returned is a strip of the whole."""
    keys = np.arange(POSES)
    payload = asking_codec.encode_ask_covariance(AskCovariance("cross", keys[5:6], keys))
    strip = asking_codec.decode_covariances(take(solver, "covariance", payload, Room())[0])
    whole = asking_codec.decode_covariances(take(solver, "covariance", ask_joint(keys), Room())[0])
    assert strip.covariance is not None
    assert whole.covariance is not None
    assert strip.covariance.shape == (3, 3 * POSES)
    np.testing.assert_allclose(strip.covariance, whole.covariance[15:18], rtol=1e-9, atol=1e-12)


def test_the_cost_is_not_below_the_answer() -> None:
    made = Solver(Options())
    made.stage(Batch((Variables("se2", np.arange(9), np.zeros((9, 3)), fixed=True),), ()))
    made.step()
    blocks, here = (
        CovarianceBlocks(made.covariances.factored()),
        Uncertain(made.covariances.factoring(), 7, 1, True, {}),
    )
    rows, columns = np.arange(9), np.arange(4)
    asked: list[tuple[AskCovariance, costs.Cost]] = [
        (AskCovariance("joint", rows), costs.of_matrix(blocks, rows, rows)),
        (AskCovariance("cross", rows, columns), costs.of_matrix(blocks, rows, columns)),
        (AskCovariance("diagonal", rows), costs.of_blocks(blocks, rows)),
    ]
    for ask, cost in asked:
        message = here.answer(ask)
        assert cost.answer <= len(message) <= cost.answer + 16 * 18 + 200


@pytest.mark.parametrize("asked", ["diagonal", "joint", "cross"])
def test_no_more_memory_is_taken_than_was_said(solver: Solver, asked: str) -> None:
    blocks, every = CovarianceBlocks(solver.covariances.factored()), np.arange(POSES)
    cost, ask = {
        "diagonal": (costs.of_blocks(blocks, every), AskCovariance("diagonal", every)),
        "joint": (costs.of_matrix(blocks, every[:300], every[:300]), AskCovariance("joint", every[:300])),
        "cross": (costs.of_matrix(blocks, every[:9], every), AskCovariance("cross", every[:9], every)),
    }[asked]
    here = Uncertain(solver.covariances.factoring(), 7, 1, True, {})
    small = AskCovariance("diagonal", every[:1])
    here.answer(small)  # R itself is another's cost
    taken = peak(lambda: here.answer(ask)) - peak(lambda: here.answer(small))
    assert cost.answer < taken <= cost.memory


def peak(call: Callable[[], object]) -> int:
    """Bytes that Python and NumPy have for it at most."""
    tracemalloc.start()
    call()
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return taken


def many(solver: Callable[[], Solver], landmarks: int) -> Solver:
    """A pose that sees a number of landmarks at one place."""
    made = solver()
    keys = np.arange(1, landmarks + 1)
    ends = np.column_stack([np.zeros_like(keys), keys])
    made.stage(
        Batch(
            (Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True), Variables("point2", keys)),
            (Factors("landmark_se2", ends, np.zeros((landmarks, 2)), np.tile([1.0, 0, 1.0], (landmarks, 1))),),
        )
    )
    made.step()
    return made


def test_association_is_bounded_in_pairs_and_in_memory(memory: MemoryLimit) -> None:
    made, one = many(Solver, 1500), np.zeros((1, 2))
    information = np.array([[1.0, 0, 1.0]])

    def ask(observations: int) -> bytes:
        rows = np.repeat(one, observations, axis=0)
        return asking_codec.encode_ask_associate(
            AskAssociate(0, "landmark_se2", rows, np.repeat(information, observations, axis=0))
        )

    assert refused(made, "associate", ask(67), Room()).detail == {"size": 100_500, "limit": 100_000}
    with pytest.raises(Exception, match="3000 compatible pairs") as caught:
        take(made, "associate", ask(2), Room())
    assert (caught.value.code, caught.value.detail) == ("too_large", {"size": 3000, "limit": 2000})  # type: ignore[attr-defined]
    memory.limit = memory.resident + (100 << 20)
    assert refused(made, "associate", ask(1), Room(memory)).code == "out_of_memory"


@pytest.mark.parametrize(
    ("question", "encode"),
    [
        ("gate", lambda factors: asking_codec.encode_ask_gate(AskGate(factors))),
        ("gain", lambda factors: asking_codec.encode_ask_gain(AskGain(factors))),
    ],
)
def test_candidates_are_bounded(question: str, encode: Callable[[tuple[Factors, ...]], bytes]) -> None:
    """100,000 in all groups."""
    made = many(Solver, 1)

    def candidates(count: int) -> tuple[Factors, ...]:
        rows = np.tile([0, 1], (count, 1)), np.zeros((count, 2)), np.tile([1.0, 0, 1.0], (count, 1))
        return (Factors("landmark_se2", *rows),)

    problem = refused(made, question, encode((*candidates(100_000), *candidates(1))), Room())
    assert (problem.code, problem.detail) == ("too_large", {"size": 100_001, "limit": 100_000})
    assert take(made, question, encode(candidates(3)), Room())[0]


def test_a_variable_with_very_many_factors_is_not_told_of_one_by_one() -> None:
    made = many(Solver, 10_001)
    problem = refused(made, "why", asking_codec.encode_ask_why(AskWhy(key=0)), Room())
    assert (problem.code, problem.detail) == ("too_large", {"size": 10_001, "limit": 10_000})
    assert take(made, "why", asking_codec.encode_ask_why(AskWhy(key=1)), Room())[0]


def test_one_that_is_refused_does_not_refuse_the_others_of_its_revision(solver: Solver) -> None:
    large, small = parse("covariance", ask_joint(np.arange(300))), parse("estimate", b"")
    taken = snapshot(solver, 7, 1, [large, small], {}, None, Room(answer_bytes=100_000))
    assert len(codec.decode_estimate(answer(small, taken)).variables) == 2
    with pytest.raises(TooLarge):
        answer(large, taken)


def test_what_is_lent_counts_for_all_until_it_is_given_back(memory: MemoryLimit) -> None:
    memory.limit = memory.resident + (1 << 30)
    memory.reserve(1 << 29)
    with pytest.raises(OutOfMemory):
        memory.reserve(3 << 28)
    memory.give_back(1 << 29)
    memory.reserve(3 << 28)
    memory.give_back(3 << 28)
    memory.limit = memory.resident  # maps have come up to the limit
    memory.reserve(memory.limit // 5)
    with pytest.raises(OutOfMemory):
        memory.reserve(memory.limit // 5)


def test_an_insert_is_taken_where_there_is_memory_for_the_code_of_its_new_kinds(memory: MemoryLimit) -> None:
    """Which its bytes do not show; what the process has made is not counted again."""
    formula = "counted(a:vector9,z:9)=" + "subtract(multiply(" * 50 + "a" + ",z),z)" * 50
    wanted = 12_000 * read_formula(formula).result_size
    assert bytes_to_compile([formula, formula, "prior_se2"]) == wanted > 10 << 20
    memory.look()
    memory.limit = memory.resident + wanted // 2
    assert memory.no_room(len(formula)) is None
    assert isinstance(memory.no_room(len(formula), wanted), OutOfMemory)
    memory.limit = memory.resident + 4 * wanted
    assert memory.no_room(len(formula), wanted) is None
    made = own_code_of(FACTOR_KINDS[formula].name)
    assert bytes_to_compile([made.formula]) == 0
