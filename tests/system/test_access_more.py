"""Access control at a router, passwords instead of certificates, no listening to strangers, no secret in any log."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import Process
from secured import ROOT, Secured

from factorbus.client import Draft, connect
from factorbus.client.link import open_link
from factorbus.proto import keys
from factorbus.proto.problems import BadSetting, Unavailable

Spawn = Callable[..., Process]
HERE = Path(__file__).parent
SECRET = "correct-horse-battery"
USERS = {"robot1": SECRET, "ops": "another-" + SECRET, "wall": "third-" + SECRET}


def test_everybody_meets_at_a_router_that_enforces(tmp_path: Path, spawn: Spawn) -> None:
    secured = Secured(tmp_path, server="fabric")
    router = spawn(str(HERE / "router.py"), "tls/127.0.0.1:0", str(secured.server)).ready()[0]
    own = ("--connect", router, "--zenoh")
    spawn(
        "-m", "factorbus.service", *own, str(secured.clients["solver"]), "--mode", "client", "--no-warm",
        "--create", "kitchen", "--create", "hall",
    ).line("ready")  # fmt: skip
    spawn("-m", "factorbus.workers", *own, str(secured.clients["w1"]), "--name", "w1", "--no-warm").ready()
    with (
        connect(router, client="robot1", zenoh=secured.clients["robot1"]) as bus,
        connect(router, client="wall", zenoh=secured.clients["wall"], timeout_s=60) as wall,
        connect(router, client="ops", zenoh=secured.clients["ops"]) as ops,
        bus.map("kitchen", create=False) as kitchen,
        wall.map("kitchen", create=False) as picture,
    ):
        accepted = kitchen.insert(Draft().se2("x0", (1, 2, 0.5), fixed=True))
        picture.estimate.wait_for(accepted.revision)
        assert picture.estimate["x0"].tolist() == [1, 2, 0.5]
        assert picture.chi2(batch=True, timeout_s=60).batch == 0.0
        seen = iter(lambda: [row["name"] for row in ops.stats()[0]["workers"]], None)
        assert next(names for names in seen if names) == ["w1"]
        ops.create("yard")
        ops.drop("yard")
    with secured.session("robot1", router) as robot1, secured.session("wall", router) as wall:
        for session, key in (
            (robot1, keys.insert_key("kitchen", "robot2-1")),
            (robot1, keys.insert_key("hall", "robot1-1")),
            (robot1, keys.admin_key("drop")),
            (robot1, keys.job_key("w1")),
            (wall, keys.insert_key("kitchen", "wall-1")),
            (wall, keys.ask_key("hall", "estimate")),
        ):
            assert list(session.get(key, timeout=5.0)) == [], key


def test_a_password_does_instead_of_a_certificate_and_appears_nowhere(
    tmp_path: Path, spawn: Spawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUST_LOG", "debug")
    secured = Secured(tmp_path, users=USERS)
    assert secured.clients["robot1"].stat().st_mode & 0o077 == 0, "a password is for its owner only"
    command = (
        "-m",
        "factorbus.cli",
        "--debug",
        "serve",
        "--listen",
        "tls/127.0.0.1:0",
        "--no-warm",
        "--map",
        "kitchen",
    )
    service = spawn(*command, "--zenoh", str(secured.server), "--log", "json")
    endpoint = service.ready()[0]
    with connect(endpoint, client="robot1", zenoh=secured.clients["robot1"]) as bus:
        kitchen = bus.map("kitchen", create=False)
        assert kitchen.insert(Draft().se2("x0", (1, 2, 0.5), fixed=True)).revision == 1
        assert SECRET not in repr(vars(bus)) + repr(vars(kitchen))
    for user, password in (("robot1", "wrong"), ("nobody", SECRET), ("robot1", "another-" + SECRET)):
        settings = {"transport/auth/usrpwd": {"user": user, "password": password}}
        with (
            pytest.raises(Unavailable, match="password") as caught,
            connect(endpoint, client="robot1", zenoh=secured.clients["wall"], settings=settings, timeout_s=0.5),
        ):
            pass
        assert SECRET not in str(caught.value)
    stats = ("-m", "factorbus.cli", "--debug", "stats", "--connect", endpoint, "--zenoh")
    told = subprocess.run(
        [sys.executable, *stats, str(secured.clients["ops"])], capture_output=True, text=True, timeout=60, check=True
    )
    denied = subprocess.run(
        [sys.executable, *stats, str(secured.clients["wall"]), "--timeout", "1"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert denied.returncode == 4
    service.end()
    said = "".join(log.read_text() for log in tmp_path.glob("*.log"))
    assert "map kitchen, mode bayes-tree" in said
    assert SECRET not in said + told.stdout + told.stderr + denied.stdout + denied.stderr


BROKEN = {
    "a comma is missing": f'{{transport: {{auth: {{usrpwd: {{user: "a", password: "{SECRET}" realm: 1}}}}}}}}',
    "quotes are missing": f"{{transport: {{auth: {{usrpwd: {{user: 'a', password: {SECRET}}}}}}}}}",
    "a field is unknown": f'{{transport: {{auth: {{usrpwd: {{user: "a", password: "{SECRET}", realm: 1}}}}}}}}',
    "it is no map": f'{{transport: {{auth: {{usrpwd: "{SECRET}"}}}}}}',
    "it is in the wrong place": f'{{mode: "{SECRET}"}}',
    "it is where a flag should be": f'{{transport: {{link: {{tls: {{enable_mtls: "{SECRET}"}}}}}}}}',
}


@pytest.mark.parametrize(
    ("command", "case"),
    [*(("stats", case) for case in BROKEN), ("serve", "quotes are missing"), ("work", "quotes are missing")],
)
def test_a_broken_configuration_is_refused_without_showing_what_is_in_it(
    tmp_path: Path, command: str, case: str
) -> None:
    broken = tmp_path / "broken.json5"
    broken.write_text(BROKEN[case])
    options = [] if command == "stats" else ["--no-warm"]
    ran = subprocess.run(
        [sys.executable, "-m", "factorbus.cli", "--debug", command, *options, "--zenoh", str(broken)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert ran.returncode == 3, ran.stderr
    assert "line 1" in ran.stderr
    assert SECRET not in ran.stdout + ran.stderr


def test_a_setting_that_is_not_taken_is_not_shown() -> None:
    for path, value in (("transport/auth/usrpwd", SECRET), (f"transport/auth/{SECRET[:3]}", SECRET), ("mode", SECRET)):
        with pytest.raises(BadSetting) as caught:
            open_link(["tcp/127.0.0.1:1"], 0.1, {path: value})
        assert SECRET not in str(caught.value)
    with pytest.raises(Unavailable) as nobody:
        open_link([f"tcp/127.0.0.1:1#connect_private_key_base64={SECRET}"], 0.1, {})
    assert SECRET not in str(nobody.value)


def serve(*options: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", "factorbus.cli", "serve", "--no-warm", *options],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:0", "tls/0.0.0.0:0", "tcp/[::]:0", "quic/0.0.0.0:0", "tcp/robot.local:0"]
)
def test_no_listening_beyond_this_machine_without_protection(endpoint: str) -> None:
    ran = serve("--listen", endpoint)
    assert (ran.returncode, "[exposed]" in ran.stderr, "--insecure" in ran.stderr) == (2, True, True)


def test_protection_has_three_parts_and_all_are_wanted(tmp_path: Path) -> None:
    secured = Secured(tmp_path)
    whole = json.loads(secured.server.read_text())
    missing = {
        "certificate": whole
        | {"transport": {"link": {"tls": whole["transport"]["link"]["tls"] | {"enable_mtls": False}}}},
        "access control": whole | {"access_control": whole["access_control"] | {"enabled": False}},
        "denies by default": whole | {"access_control": whole["access_control"] | {"default_permission": "allow"}},
    }
    for what, configuration in missing.items():
        (tmp_path / "less.json5").write_text(json.dumps(configuration))
        ran = serve("--listen", "tls/0.0.0.0:0", "--zenoh", str(tmp_path / "less.json5"))
        assert (ran.returncode, what in ran.stderr) == (2, True), ran.stderr
    ran = serve("--listen", "tcp/0.0.0.0:0", "--zenoh", str(secured.server))
    assert (ran.returncode, "no encryption" in ran.stderr) == (2, True)


def test_when_told_so_it_tries() -> None:
    ran = serve("--listen", "tcp/192.0.2.1:0", "--insecure")  # an address that no machine has
    assert (ran.returncode, "cannot listen at tcp/192.0.2.1:0" in ran.stderr) == (2, True)


def test_the_ready_configurations_are_what_the_command_makes(tmp_path: Path) -> None:
    folder = ROOT / "deploy" / "zenoh"
    command = [sys.executable, "-m", "factorbus.cli", "access", str(folder / "access.toml"), "--out"]
    for name, options in {
        "service.json5": (),
        "router.json5": ("--name", "router"),
        "robot1.json5": ("--client", "robot1"),
        "viewer1.json5": ("--client", "viewer1"),
        "worker1.json5": ("--client", "worker1"),
        "operator1.json5": ("--client", "operator1"),
        "boat1.json5": ("--client", "boat1"),
    }.items():
        made = tmp_path / name
        ran = subprocess.run([*command, str(made), *options, "--json"], check=True, timeout=60, stdout=subprocess.PIPE)
        assert json.loads(ran.stdout) == {"files": [str(made)]}
        assert made.read_text() == (folder / name).read_text(), f"make it anew: factorbus access ... --out {name}"
