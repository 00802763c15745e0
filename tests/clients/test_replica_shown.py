"""What stats, top and doctor say of a replica."""

from typing import Any

from factorbus.cli.commands.stats import _upstream
from factorbus.cli.commands.top import _upstreams
from factorbus.cli.doctor.service_checks import _following

ROW: dict[str, Any] = {
    "endpoint": "tcp/base:7447", "connected": True, "since_s": 65.0, "behind": 0, "record": 9, "rebased": 0,
    "refused": 0, "same_bits": True, "code": "", "problem": "",
}  # fmt: skip


def test_a_replica_that_follows_is_fine() -> None:
    assert list(_following("yard", ROW)) == []
    assert _upstream(ROW).startswith("tcp/base:7447, connected for ")


def test_a_link_that_is_down_is_a_warning_with_what_waits() -> None:
    ((state, seen, mend),) = _following("yard", ROW | {"connected": False, "behind": 12})
    assert (state, "lacks 12 inserts of map yard, out of reach for 65 s" in seen) == ("warn", True)
    assert "goes on" in mend
    assert "out of reach" in _upstream(ROW | {"connected": False, "behind": 12, "rebased": 1})


def test_what_upstream_refuses_is_a_failure_with_its_code() -> None:
    ((state, seen, mend),) = _following("yard", ROW | {"code": "records_differ", "problem": "no"})
    assert (state, "no" in seen, "`factorbus explain records_differ`" in mend) == ("fail", True, True)
    assert _upstream(ROW | {"problem": "no"}).endswith(": no")


def test_other_bits_are_a_warning() -> None:
    ((state, seen, _),) = _following("yard", ROW | {"same_bits": False})
    assert (state, "other bits" in seen) == ("warn", True)


def test_top_has_a_line_of_each_map_that_follows() -> None:
    names, rows = _upstreams({"maps": [{"name": "hall"}, {"name": "yard", "upstream": ROW}]})
    assert names == ("replica", "upstream", "link", "behind", "rebased")
    assert rows == [("yard", "tcp/base:7447", "connected for 65 s", "0", "0")]


def test_top_says_why_a_map_does_not_follow() -> None:
    _, ((*_, link, _, _),) = _upstreams({"maps": [{"name": "yard", "upstream": ROW | {"code": "other_keep"}}]})
    assert link == "connected for 65 s, other_keep"
