"""What is uploaded: README's links lead somewhere from the package's page; a release that lacks something says so."""

import hashlib
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
URL = "https://example.org/somebody/factorbus"


def loaded(name: str) -> ModuleType:
    """A script of the release as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"deploy/release/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def urls() -> ModuleType:
    return loaded("project_urls")


@pytest.mark.parametrize("words", [[], ["python3"], ["python3", "out", "--reharse"], ["python3", "out", "", "more"]])
def test_words_that_are_not_known_are_refused_before_anything_is_built(words: list[str], tmp_path: Path) -> None:
    """Of --reharse would have come a release, with a signed tag."""
    command = ["bash", str(ROOT / "deploy/release/release.sh"), *words]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (ran.returncode, ran.stdout, list(tmp_path.iterdir())) == (2, "", [])
    assert ran.stderr == f"wanted: deploy/release/release.sh PYTHON FOLDER [--rehearse], seen: {' '.join(words)}\n"


def test_the_bill_of_materials_is_of_this_version_and_not_of_the_environment() -> None:
    """As cyclonedx-py writes it: a subject without a version, and what every environment has."""
    bill = {
        "metadata": {"component": {"bom-ref": "root-component", "name": "factorbus", "type": "library"}, "tools": 1},
        "components": [{"bom-ref": f"{name}==1", "name": name} for name in ("numpy", "pillow", "pip", "setuptools")],
        "dependencies": [
            {"ref": "root-component", "dependsOn": ["numpy==1", "pillow==1"]},
            {"ref": "pillow==1", "dependsOn": ["numpy==1", "setuptools==1"]},
            {"ref": "setuptools==1", "dependsOn": ["pip==1"]},
            {"ref": "numpy==1"},
            {"ref": "pip==1"},
        ],
    }
    made = loaded("bill_of_materials").completed(bill, "1.2.3")
    subject = made["metadata"]["component"]
    assert (subject["version"], subject["purl"]) == ("1.2.3", "pkg:pypi/factorbus@1.2.3")
    assert made["metadata"]["tools"] == 1
    assert [each["name"] for each in made["components"]] == ["numpy", "pillow"]
    assert made["dependencies"] == [
        {"ref": "root-component", "dependsOn": ["numpy==1", "pillow==1"]},
        {"ref": "pillow==1", "dependsOn": ["numpy==1"]},
        {"ref": "numpy==1"},
    ]


def test_the_provenance_leads_to_the_source_and_has_the_hash_of_each_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("factorbus-1.2.3-py3-none-any.whl", "factorbus-1.2.3.tar.gz", "factorbus-1.2.3.cdx.json"):
        (tmp_path / name).write_text(name)
    provenance = loaded("provenance")
    monkeypatch.setattr(provenance, "version", lambda _: "9")  # what builds is not installed here
    said = {}
    for url in ("", f"{URL}/"):
        monkeypatch.setenv("FACTORBUS_URL", url)
        provenance.main(str(ROOT), str(tmp_path), "1.2.3")
        said[url] = json.loads(capsys.readouterr().out)
    subjects = {each["name"]: each["digest"]["sha256"] for each in said[""]["subject"]}
    packages = [each for each in tmp_path.iterdir() if each.suffix != ".json"]
    assert subjects == {each.name: hashlib.sha256(each.read_bytes()).hexdigest() for each in packages}
    source = said[f"{URL}/"]["predicate"]["buildDefinition"]["resolvedDependencies"][0]
    assert source["uri"] == f"git+{URL}@refs/tags/v1.2.3"
    assert re.fullmatch(r"[0-9a-f]{40}", source["digest"]["gitCommit"])
    builder = said[f"{URL}/"]["predicate"]["runDetails"]["builder"]["id"]
    assert builder == f"{URL}/blob/v1.2.3/deploy/release/release.sh"
    assert said[""]["predicate"]["buildDefinition"]["resolvedDependencies"][0]["uri"] == "git+file:factorbus"


def test_each_link_of_readme_leads_to_a_file_of_the_tag(urls: ModuleType) -> None:
    text = urls.absolute((ROOT / "README.md").read_text(), URL, "v1.2.3")
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    own = [target.removeprefix(URL) for target in targets if target.startswith(URL)]
    assert len(own) > 10
    assert all(re.match(r"https?:|#", target) for target in targets)
    for target in own:
        way, tag, path = re.fullmatch(r"/(blob|raw)/([^/]+)/([^#]+)(?:#.*)?", target).groups()
        assert tag == "v1.2.3"
        assert (way == "raw") == path.endswith(".png")
        assert (ROOT / path).exists()


def test_the_package_has_the_urls_of_the_address_it_is_given(urls: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    hook = urls.ProjectUrls(str(ROOT), {})
    monkeypatch.setenv("FACTORBUS_URL", f"{URL}/")
    given: dict = {}
    hook.update(given)
    assert given["urls"]["Homepage"] == URL
    assert f"]({URL}/blob/v" in given["readme"]["text"]
    monkeypatch.delenv("FACTORBUS_URL")
    without: dict = {}
    hook.update(without)
    assert without == {"readme": {"content-type": "text/markdown", "text": (ROOT / "README.md").read_text()}}


def test_a_release_that_lacks_something_names_all_of_it_and_builds_nothing(tmp_path: Path) -> None:
    clone = tmp_path / "clone"
    for each in ("deploy/release/release.sh", "proto/factorbus/proto/version.py", "CHANGELOG.md"):
        (clone / each).parent.mkdir(parents=True, exist_ok=True)
        (clone / each).write_bytes((ROOT / each).read_bytes())
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("GIT_", "FACTORBUS_"))}
    environment |= {"HOME": str(tmp_path), "GIT_CONFIG_NOSYSTEM": "1"}
    subprocess.run(["git", "init", "--quiet", str(clone)], check=True, env=environment)
    command = ["bash", str(clone / "deploy/release/release.sh"), sys.executable, str(tmp_path / "out")]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert ran.returncode == 1
    for what in ("not committed", "has no section [", "no key to sign with", "FACTORBUS_URL is ''", "--rehearse"):
        assert what in ran.stderr
    assert not (tmp_path / "out").exists()
