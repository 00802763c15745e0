"""Completes a bill of materials of cyclonedx-py, which is of an environment: its subject gets the version and address
of the release, and what the environment itself brings (pip, setuptools) goes.

python bill_of_materials.py FILE.cdx.json VERSION
"""

import json
import sys
from pathlib import Path
from typing import Any

_OF_ENVIRONMENTS = {"pip", "setuptools", "wheel"}


def completed(bill: dict[str, Any], version: str) -> dict[str, Any]:
    """The bill of this version."""
    subject = bill["metadata"]["component"] | {"version": version, "purl": f"pkg:pypi/factorbus@{version}"}
    gone = {each["bom-ref"] for each in bill["components"] if each["name"] in _OF_ENVIRONMENTS}
    depends = [
        each | ({"dependsOn": sorted(set(each["dependsOn"]) - gone)} if "dependsOn" in each else {})
        for each in bill["dependencies"]
        if each["ref"] not in gone
    ]
    return bill | {
        "metadata": bill["metadata"] | {"component": subject},
        "components": [each for each in bill["components"] if each["bom-ref"] not in gone],
        "dependencies": depends,
    }


def main(file: str, version: str) -> None:
    """In place."""
    path = Path(file)
    path.write_text(json.dumps(completed(json.loads(path.read_text()), version), indent=2) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
