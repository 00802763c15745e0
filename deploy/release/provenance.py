"""Prints where a release comes from: an in-toto statement with SLSA's provenance of the files of a folder.

python provenance.py ROOT FOLDER VERSION

With FACTORBUS_URL the source is that address with the tag of the version, and the builder a file of it.
"""

import hashlib
import json
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

_SCRIPT = "deploy/release/release.sh"


def main(root: str, folder: str, of_version: str) -> None:
    """The statement, on standard output."""

    def git(*arguments: str) -> str:
        ran = subprocess.run(["git", "-C", root, *arguments], capture_output=True, text=True, check=True)
        return ran.stdout.strip()

    url, tag = os.environ.get("FACTORBUS_URL", "").rstrip("/"), f"v{of_version}"
    source = f"git+{url}@refs/tags/{tag}" if url else "git+file:factorbus"
    builder = f"{url}/blob/{tag}/{_SCRIPT}" if url else _SCRIPT
    commit = git("rev-parse", "HEAD")
    built = [*sorted(Path(folder).glob("factorbus-*.whl")), *sorted(Path(folder).glob("factorbus-*.tar.gz"))]
    tools = {name: version(name) for name in ("build", "hatchling")} | {"python": platform.python_version()}
    statement = {
        "_type": "https://in-toto.io/Statement/v1",
        "subject": [
            {"name": each.name, "digest": {"sha256": hashlib.sha256(each.read_bytes()).hexdigest()}} for each in built
        ],
        "predicateType": "https://slsa.dev/provenance/v1",
        "predicate": {
            "buildDefinition": {
                "buildType": "https://packaging.python.org/en/latest/flow/",
                "externalParameters": {"source_date_epoch": int(git("log", "-1", "--format=%ct"))},
                "internalParameters": {"script": _SCRIPT},
                "resolvedDependencies": [{"uri": source, "digest": {"gitCommit": commit}}],
            },
            "runDetails": {"builder": {"id": builder, "version": tools}},
        },
    }
    json.dump(statement, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main(*sys.argv[1:])
