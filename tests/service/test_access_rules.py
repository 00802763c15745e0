"""Roles to Zenoh's rules: what is written down, and what is refused.  That the rules hold is shown over the bus."""

import pytest
import zenoh

from factorbus.service.bus.access import access_control, read_grants
from factorbus.service.config import BadConfig

GOOD = '[front_end]\nrobot1 = ["kitchen", "site7-*"]\n[worker]\nw1 = []\n[operator]\nops = ["*"]\n'


def test_every_name_gets_rules_of_its_own() -> None:
    written = access_control(read_grants(GOOD))
    assert written["default_permission"] == "deny"
    assert [subject["cert_common_names"] for subject in written["subjects"]] == [["robot1"], ["w1"], ["ops"]]
    inserts = {
        key
        for rule in written["rules"]
        if rule["id"].startswith("robot1 ") and rule["messages"] == ["query"]
        for key in rule["key_exprs"]
        if "/in/" in key
    }
    assert inserts == {
        f"factorbus/v1/map/{name}/in/robot1{suffix}" for name in ("kitchen", "site7-$*") for suffix in ("", "-$*")
    }
    assert "usernames" in access_control(read_grants(GOOD), "usernames")["subjects"][0]


def test_every_key_is_one_that_zenoh_takes() -> None:
    roles = "".join(
        f'[{role}]\n{role}1 = ["a", "b-*", "*"]\n' for role in ("front_end", "viewer", "operator", "replica", "service")
    )
    for rule in access_control(read_grants(roles + "[worker]\nw1 = []\n[router]\nr1 = []\n"))["rules"]:
        for key in rule["key_exprs"]:
            zenoh.KeyExpr(key)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[robots]\nr1 = []", "'robots' is no role"),
        ("front_end = 3", "wanted a table"),
        ('[front_end]\nr-1 = ["a"]', "and no -"),
        ('[front_end]\n"r*" = ["a"]', "will not do"),
        ('[front_end]\nr1 = "a"', "wanted maps"),
        ('[front_end]\nr1 = ["a/b"]', "wanted maps"),
        ('[front_end]\nr1 = ["*a"]', "wanted maps"),
        ("[front_end]\nr1 = []", "at least one map"),
        ('[worker]\nw1 = ["a"]', "no map"),
        ('[viewer]\nx = ["a"]\n[operator]\nx = ["a"]', "one role for a name"),
        ("[viewer", "is not TOML"),
    ],
)
def test_what_cannot_be_meant_is_refused(text: str, said: str) -> None:
    with pytest.raises(BadConfig, match=said):
        read_grants(text)
