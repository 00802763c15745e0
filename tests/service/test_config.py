"""Settings from a file: what is there is used, what is misspelt is said."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from factorbus.proto.problems import BadName
from factorbus.service.config import BadConfig, Config, Limits, checked_config, load_config


def test_a_file_sets_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "factorbus.toml"
    path.write_text(
        'listen = ["tcp/0.0.0.0:7447"]\nmaps = "site7-*"\njob_deadline_s = 5\n[limits]\nwaiting = 9\nparked_s = 2\n'
    )
    config = load_config(path, name="s1")
    assert config == Config(
        listen=("tcp/0.0.0.0:7447",),
        maps="site7-*",
        name="s1",
        job_deadline_s=5.0,
        limits=Limits(waiting=9, parked_s=2.0),
    )


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("job_deadline_s = inf", "job_deadline_s is inf; wanted a number below 1e"),
        ("stuck_s = nan", "stuck_s is nan"),
        ("group_s = inf", "group_s is inf"),
        ("checkpoint_s = 1e300", "checkpoint_s is 1e"),
        ("[limits]\nparked_s = inf", "parked_s is inf"),
        ("[limits]\nparked_s = nan", "parked_s is nan"),
        ("lissten = []", "'lissten' is not a setting"),
        ("[limits]\nwating = 3", "'wating' is not a setting"),
        ('listen = "tcp/0.0.0.0:1"', "wanted an array"),
        ("listen = [1]", "wanted a string"),
        ("limits = 3", "wanted a table"),
        ("[limits]\nwaiting = 0", "wanted more than 0"),
        ("[limits]\nwaiting = 1.5", "wanted a whole number"),
        ("[limits]\nwaiting = true", "wanted a whole number"),
        ('mode = "hub"', "wanted peer, router or client"),
        ('mode = "client"', "nothing to connect to"),
        ('upstream = "tcp/base:7447"', "upstream without a journal"),
        ('upstream_zenoh = "robot.json5"', "without an upstream"),
        ('upstream = "tcp/127.0.0.1:7447"\njournal = "j"', "where this service listens"),
        ('upstream = "tcp/localhost:7448"\njournal = "j"\nlisten = ["tcp/0.0.0.0:7448"]', "where this service listens"),
        ("listen = []", "nothing to listen on"),
        ('maps = "a/*"', "wanted a map name"),
        ("job_deadline_s = -1", "wanted more than 0"),
        ("cores = 0", "cores is 0; wanted 1"),
        ("cores_from_bytes = -1", "cores_from_bytes is -1; wanted 0"),
        ("mode = ", "not TOML"),
    ],
)
def test_what_cannot_be_is_named(tmp_path: Path, text: str, wanted: str) -> None:
    path = tmp_path / "factorbus.toml"
    path.write_text(text)
    with pytest.raises(BadConfig, match=wanted):
        load_config(path)


def test_the_name_of_a_service_is_looked_at_before_its_maps_are_opened() -> None:
    with pytest.raises(BadName, match="service name 'a b' will not do"):
        checked_config(replace(Config(), name="a b"))


def test_the_defaults_can_work() -> None:
    assert checked_config(Config()) == Config()


@pytest.mark.parametrize("setting", [{"durability": "group"}, {"group_s": 1.0}, {"checkpoint_s": 1.0}])
def test_what_is_of_a_journal_wants_one(setting: dict[str, Any]) -> None:
    with pytest.raises(BadConfig, match="without a journal"):
        checked_config(replace(Config(), **setting))
    assert checked_config(replace(Config(journal="maps"), **setting))
