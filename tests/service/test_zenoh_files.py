"""A Zenoh configuration that cannot be is said at the start, whichever option names it, and before any kernel."""

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import factorbus.solver
from factorbus.proto.problems import BadConfigurationFile
from factorbus.service import app
from factorbus.service.config import BadConfig, Config
from factorbus.workers.app import work
from factorbus.workers.config import WorkerConfig

REPLICA = Config(listen=("tcp/127.0.0.1:0",), upstream="tcp/127.0.0.1:9", journal="maps")
BAD = {
    "missing": (None, "No such file"),
    "a folder": ("", "Is a directory"),
    "empty": ("", "Empty config file"),
    "cut off": ("{", "expected identifier"),
    "no setting": ("{nosuch: 1}", "unknown field `nosuch`"),
    "not text": ("\udcff\udcfe", "UTF-8"),
}


@pytest.fixture
def file(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "zenoh.json5"
    if case == "a folder":
        path.mkdir()
    elif (content := BAD[case][0]) is not None:
        path.write_text(content, "utf-8", "surrogateescape")
    return path


def not_reached(*_: Any, **__: Any) -> Any:
    raise AssertionError("it went on")


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("setting", ["zenoh", "upstream_zenoh"])
def test_a_service_does_not_begin_with_it(setting: str, case: str, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(app, "ready_to_compute", not_reached)
    config = replace(REPLICA, **{setting: str(file)})
    with pytest.raises(BadConfigurationFile, match=BAD[case][1]) as bad:
        app.serve(config, not_reached, threading.Event())
    assert str(file) in bad.value.message
    assert bad.value.code == "bad_file"
    assert not Path("maps").exists()


@pytest.mark.parametrize("case", BAD)
def test_a_worker_does_not_begin_with_it(case: str, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(factorbus.solver, "warm", not_reached)
    with pytest.raises(BadConfigurationFile, match=BAD[case][1]) as bad:
        work(WorkerConfig(zenoh=str(file)), not_reached, threading.Event())
    assert str(file) in bad.value.message


def test_a_replica_does_not_begin_with_keys_that_others_can_replace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    key = tmp_path / "key.pem"
    key.write_text("")
    key.chmod(0o666)
    file = tmp_path / "zenoh.json5"
    file.write_text(f'{{transport: {{link: {{tls: {{connect_private_key: "{key}"}}}}}}}}')
    config = replace(REPLICA, warm=False, upstream_zenoh=str(file))
    with pytest.raises(BadConfig, match=r"key\.pem") as bad:
        app.serve(config, not_reached, threading.Event())
    assert bad.value.code == "unsafe_folder"


@pytest.mark.parametrize("setting", ["zenoh", "upstream_zenoh"])
def test_a_service_does_not_begin_with_a_configuration_that_others_can_write_to(
    setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "ready_to_compute", not_reached)
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "zenoh.json5"
    file.write_text("{}")
    file.chmod(0o666)
    config = replace(REPLICA, warm=False, **{setting: str(file)})
    with pytest.raises(BadConfig, match=r"zenoh\.json5 is not used: everybody can write to it") as bad:
        app.serve(config, not_reached, threading.Event())
    assert bad.value.code == "unsafe_folder"
