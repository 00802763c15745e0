"""Writes requirements.txt: what the image installs, by version and hashes of the wheels for x86-64 and aarch64.

    python deploy/docker/pin.py > deploy/docker/requirements.txt

Run it to take up new versions, then `make test`.  It asks the package index, by pip.
"""

import json
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Of the image, and of the oldest glibc that it has: Debian 12.
PYTHON, GLIBC = "3.12", 36
MACHINES = ("x86_64", "aarch64")


def main() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wanted = [
        *project["project"]["dependencies"],
        *project["project"]["optional-dependencies"]["service"],
        *project["build-system"]["requires"],
    ]
    hashes: dict[str, set[str]] = defaultdict(set)
    for machine in MACHINES:
        for name, version, digest in _chosen(wanted, machine):
            hashes[f"{name}=={version}"].add(digest)
    print(f"# Made by deploy/docker/pin.py for Python {PYTHON} on {' and '.join(MACHINES)}.")
    for each in sorted(hashes):
        print(" \\\n    ".join([each, *(f"--hash=sha256:{digest}" for digest in sorted(hashes[each]))]))


def _chosen(wanted: list[str], machine: str) -> Iterator[tuple[str, str, str]]:
    """(name, version, SHA-256) of each wheel that pip would take, of PyPI's and nobody else's."""
    platforms = [f"--platform=manylinux_2_{glibc}_{machine}" for glibc in range(GLIBC, 16, -1)]
    asked = subprocess.run(
        [
            sys.executable, "-m", "pip", "--isolated", "install", "--quiet", "--dry-run", "--ignore-installed",
            "--report=-", "--index-url=https://pypi.org/simple", "--only-binary=:all:", f"--python-version={PYTHON}",
            f"--platform=manylinux2014_{machine}", *platforms, "--target=unused", *wanted,
        ],
        check=True, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    for each in json.loads(asked.stdout)["install"]:
        about = each["metadata"]
        digest = each["download_info"]["archive_info"]["hashes"]["sha256"]
        yield re.sub(r"[-_.]+", "-", about["name"]).lower(), about["version"], digest


if __name__ == "__main__":
    main()
