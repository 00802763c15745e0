"""The image installs from what it copies, what is pinned, and for both processors."""

import fnmatch
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
DOCKER = ROOT / "deploy" / "docker"
# Of the image; the tests may run with a later one.
PYTHON = {"python_version": "3.12", "python_full_version": "3.12.0"}


def test_the_package_is_built_from_what_the_image_copies(tmp_path: Path) -> None:
    """Of the build context nothing else reaches it; the ignore file lets in what it names."""
    let_in = [line[1:] for line in (DOCKER / "Dockerfile.dockerignore").read_text().splitlines() if line[:1] == "!"]
    text = (DOCKER / "Dockerfile").read_text().replace("\\\n", " ")
    for line in re.findall(r"^COPY (?!--from)(.+)$", text, re.M):
        *sources, target = line.split()
        for source in sources:
            assert any(source == each or fnmatch.fnmatch(source, f"{each}/*") for each in let_in), source
            into = tmp_path / (f"{target}/{Path(source).name}" if target.endswith("/") else target)
            into.parent.mkdir(parents=True, exist_ok=True)
            copy = shutil.copytree if (ROOT / source).is_dir() else shutil.copy
            copy(ROOT / source, into)
    (words,) = re.findall(r"pip (install .*--no-build-isolation \.)", text)
    ran = subprocess.run(
        [sys.executable, "-m", "pip", *words.split(), "--target", str(tmp_path / "installed")],
        cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "installed" / "factorbus" / "service" / "__init__.py").exists()


def pinned() -> dict[str, tuple[str, int]]:
    """name: (version, number of hashes)."""
    text = (DOCKER / "requirements.txt").read_text()
    found = re.findall(r"^([a-z0-9-]+)==(\S+) \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", text, re.M)
    assert len(found) == text.count("==")
    return {name: (version, hashes.count("--hash")) for name, version, hashes in found}


def test_all_that_the_image_installs_is_pinned_and_allowed() -> None:
    """By what is installed here of each: a new dependency, or a bound that moved, wants `pin.py` again."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [
        *project["project"]["dependencies"],
        *project["project"]["optional-dependencies"]["service"],
        *project["build-system"]["requires"],
    ]
    found, seen = pinned(), set()
    while wanted:
        each = Requirement(wanted.pop())
        name = re.sub(r"[-_.]+", "-", each.name).lower()
        if each.marker is not None and not each.marker.evaluate({**PYTHON, "extra": ""}):
            continue
        assert name in found, f"{name} is not in requirements.txt: python deploy/docker/pin.py"
        assert each.specifier.contains(found[name][0]), f"{each}, pinned {found[name][0]}"
        if name not in seen:
            seen.add(name)
            wanted += requires(name) or ()
    assert seen == set(found)


def test_what_is_compiled_has_a_wheel_for_each_processor() -> None:
    assert {name for name, (_, hashes) in pinned().items() if hashes == 2} == {
        "eclipse-zenoh", "llvmlite", "msgpack", "numba", "numpy", "scipy",
    }  # fmt: skip


def test_both_processors_are_built_and_the_native_one_alone() -> None:
    """No buildx is here: only its lines are read."""
    text = (DOCKER / "bake.hcl").read_text()
    assert '["linux/amd64", "linux/arm64"]' in text
    (native,) = re.findall(r'target "native" \{(.*?)\}', text, re.S)
    assert re.search(r"platforms += \[\]", native)
    (file,) = re.findall(r'dockerfile = "(.*)"', text)
    assert (ROOT / file).exists()


@pytest.mark.parametrize("name", ["solver", "worker"])
def test_kernels_outlive_their_pod(name: str) -> None:
    yaml = pytest.importorskip("yaml")
    documents = list(yaml.safe_load_all((ROOT / "deploy" / "kubernetes" / f"{name}.yaml").read_text()))
    (owner,) = (each for each in documents if each["kind"] == "StatefulSet")
    assert "kernels" in [claim["metadata"]["name"] for claim in owner["spec"]["volumeClaimTemplates"]]
    assert owner["spec"]["serviceName"] in [each["metadata"]["name"] for each in documents if each["kind"] == "Service"]
