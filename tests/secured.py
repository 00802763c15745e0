"""A secured bus for the tests: an authority, certificates, and configurations made as an operator would."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import zenoh

ROOT = Path(__file__).parent.parent
SCRIPT = ROOT / "deploy" / "zenoh" / "certificates.sh"

ACCESS = """
[front_end]
robot1 = ["kitchen"]
robot2 = ["kitchen", "hall"]
[viewer]
wall = ["kitchen"]
[worker]
w1 = []
[operator]
ops = ["*"]
[replica]
boat = ["hall"]
[service]
solver = ["*"]
"""
NAMES = ("robot1", "robot2", "wall", "w1", "ops", "boat")


class Secured:
    """A folder with everything in it.  users: passwords instead of client certificates, by name."""

    def __init__(self, folder: Path, users: dict[str, str] | None = None, server: str = "hub") -> None:
        self.folder = folder
        self._users = folder / "users.txt" if users else None
        if self._users is not None and users is not None:
            self._users.write_text("".join(f"{name}:{password}\n" for name, password in users.items()))
        self.certificate("authority")
        self.certificate("server", server, "localhost", "127.0.0.1")
        self.certificate("client", *NAMES, "solver", "stranger")
        (folder / "access.toml").write_text(ACCESS)
        self.server = self._access("--name", server, "--out", str(folder / f"{server}.json5"))
        self.clients = {
            name: self._access("--client", name, "--out", str(folder / f"{name}.json5"))
            for name in (*NAMES, "solver")
            if users is None or name in users
        }

    def certificate(self, *arguments: str) -> None:
        """What the script makes of `arguments`."""
        subprocess.run(["bash", str(SCRIPT), str(self.folder), *arguments], check=True, timeout=60)

    def config(self, name: str, endpoint: str, **paths: object) -> zenoh.Config:
        """The configuration of a bare session of `name`."""
        config = zenoh.Config.from_file(str(self.clients[name]))
        settings = {
            "mode": "client",
            "connect/endpoints": [endpoint],
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,
        }
        for path, value in (settings | paths).items():
            config.insert_json5(path, json.dumps(value))
        return config

    @contextmanager
    def session(self, name: str, endpoint: str) -> Iterator[zenoh.Session]:
        """A bare session of `name`."""
        with zenoh.open(self.config(name, endpoint)) as opened:
            yield opened

    def _access(self, *arguments: str) -> Path:
        users = ("--users", str(self._users)) if self._users else ()
        command = [sys.executable, "-m", "factorbus.cli", "access", str(self.folder / "access.toml"), *users]
        command += ["--certificates", str(self.folder), *arguments]
        subprocess.run(command, check=True, timeout=60, env=os.environ | {"PYTHONWARNINGS": "error"})
        return Path(arguments[-1])
