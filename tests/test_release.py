"""What is uploaded: README's links lead somewhere from the package's page; a release that lacks something says so."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
URL = "https://example.org/somebody/factorbus"


@pytest.fixture(scope="module")
def urls() -> ModuleType:
    spec = importlib.util.spec_from_file_location("project_urls", ROOT / "deploy/release/project_urls.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
