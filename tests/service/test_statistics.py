"""What a map has done: what is noted is counted when somebody asks, and is in no answer twice."""

from factorbus.service.core.statistics import InsertDone, MapStatistics


def done(chi2: float) -> InsertDone:
    return InsertDone("tree", chi2, 2.0, 0.004, 100, 200)


def test_what_was_noted_is_in_every_answer_once() -> None:
    statistics = MapStatistics()
    statistics.received(50)
    statistics.note(done(1.0))
    statistics.stepped("batch", 7.0, 3.0, 5)
    for _ in range(2):
        stats, more = statistics.stats(), statistics.for_operators()
        assert stats == {
            "chi2": 7.0,
            "inserts": {"accepted": 1, "refused": 0, "busy": 0},
            "strategies": {"batch": 1, "tree": 1},
            "solver_ms": 5.0,
        }
        assert more["bytes"] == {"received": 50, "answered": 100, "published": 205}
        assert sum(more["step_s"]["counts"]) == 2
        assert sum(more["insert_s"]["counts"]) == 1


def test_nothing_is_lost_however_much_is_noted() -> None:
    statistics = MapStatistics()
    for n in range(5000):
        statistics.note(done(float(n)))
    stats = statistics.stats()
    assert (stats["inserts"]["accepted"], stats["chi2"], stats["solver_ms"]) == (5000, 4999.0, 10_000.0)
