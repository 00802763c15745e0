"""What is in deploy/ fits what the code has: settings, files, units, names of metrics."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from factorbus.service.config import load_config
from factorbus.service.core.statistics import Histogram
from factorbus.service.operations.metrics import families

DEPLOY = Path(__file__).parent.parent / "deploy"
BIN = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
NAME = re.compile(r"factorbus_[a-z0-9_]+")
_NUMBERS = [
    "variables",
    "factors",
    "revision",
    "chi2",
    "converged",
    "converging",
    "clients",
    "waiting",
    "parked",
    "in_solver",
]


def health(more: dict[str, Any]) -> dict[str, Any]:
    """Of a service with one map, whose row has `more`, and one worker."""
    row = dict.fromkeys([*_NUMBERS, "steps", "solver_cpu_s"], 1)
    row |= {"name": "m", "step_s": Histogram().as_dict(), "insert_s": Histogram().as_dict()}
    row |= {name: {"x": 1} for name in ("strategies", "inserts", "refusals", "bytes")}
    return {
        "service": "s", "version": "1", "uptime_s": 1.0, "alive": True, "ready": True, "silent_s": {"watch": 0.0},
        "memory": {"resident_bytes": 1, "limit_bytes": 2},
        "maps": [row | {"journal": {"bytes": 3, "blocked": 0}} | more],
        "workers": [{"name": "w", "slots": 1, "in_flight": 0, "latency_ms": 0.2}],
        "cores": {"used": 2, "pieces": 7}, "disk": {"free_bytes": 3, "size_bytes": 4},
    }  # fmt: skip


def known() -> set[str]:
    """Every metric that it has, as Prometheus names it."""
    names = set()
    for family in families(health({})):
        ends = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count")}.get(family.kind, ("",))
        names |= {f"factorbus_{family.name}{end}" for end in ends}
    return names


@pytest.mark.parametrize("file", ["grafana/factorbus.json", "prometheus/alerts.yml"])
def test_dashboards_and_alerts_ask_for_metrics_there_are(file: str) -> None:
    asked = set(NAME.findall((DEPLOY / file).read_text()))
    assert len(asked) > 3
    assert asked <= known()


def test_another_part_of_the_service_can_add_numbers() -> None:
    assert "factorbus_map_journal_bytes" in known()


def test_closures_are_counted_by_state_of_maps_that_test_theirs() -> None:
    states = {"accepted": 7, "suspect": 2, "rejected": 1, "restored": 0}
    found = [family for family in families(health({"closure_states": states})) if family.name == "map_closures"]
    assert [(family.kind, family.labels) for family in found] == [("gauge", ("map", "state"))]
    assert found[0].samples == [(("m", state), count) for state, count in states.items()]
    assert all(not family.samples for family in families(health({})) if family.name == "map_closures")


def test_the_dashboard_is_one() -> None:
    panels = json.loads((DEPLOY / "grafana" / "factorbus.json").read_text())["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels) > 10


@pytest.mark.parametrize("file", ["systemd/serve.toml", "docker/serve.toml"])
def test_the_settings_are_settings(file: str) -> None:
    assert load_config(DEPLOY / file, insecure=True).metrics


def test_what_the_image_copies_is_there() -> None:
    lines = (DEPLOY / "docker" / "Dockerfile").read_text().splitlines()
    copied = [word for line in lines if line.startswith("COPY") and "--from" not in line for word in line.split()[1:-1]]
    assert len(copied) > 5
    assert all((DEPLOY.parent / word).exists() for word in copied)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_takes_the_units(tmp_path: Path) -> None:
    for unit in (DEPLOY / "systemd").glob("*.service"):
        # It looks for the program, which is installed elsewhere.
        (tmp_path / unit.name).write_text(unit.read_text().replace("/opt/factorbus/bin/factorbus", "/bin/true"))
    units = [str(each) for each in tmp_path.glob("*.service")]
    ran = subprocess.run(["systemd-analyze", "verify", *units], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stderr) == (0, ""), ran.stderr


@pytest.mark.skipif(shutil.which("hadolint", path=BIN) is None, reason="hadolint is not installed")
def test_hadolint_takes_the_image() -> None:
    # DL3008, versions of Debian packages: those of a release move with its security updates, and old ones are gone.
    words = ["hadolint", "--no-color", "--ignore", "DL3008", str(DEPLOY / "docker" / "Dockerfile")]
    ran = subprocess.run(words, capture_output=True, text=True, timeout=60, env={**os.environ, "PATH": BIN})
    assert (ran.returncode, ran.stdout) == (0, "")


@pytest.mark.skipif(shutil.which("kubernetes-validate", path=BIN) is None, reason="kubernetes-validate is missing")
@pytest.mark.parametrize("file", sorted((DEPLOY / "kubernetes").glob("*.yaml")), ids=lambda path: path.name)
def test_kubernetes_takes_the_manifests(file: Path) -> None:
    words = ["kubernetes-validate", "--strict", str(file)]
    ran = subprocess.run(words, capture_output=True, text=True, timeout=60, env={**os.environ, "PATH": BIN})
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_what_the_manifests_configure_is_a_configuration(tmp_path: Path) -> None:
    (made,) = re.findall(r"printf '(.*?)'", (DEPLOY / "kubernetes" / "solver.yaml").read_text())
    settings = tmp_path / "serve.toml"
    settings.write_text(made.replace("\\n", "\n") % ("2", "factorbus-solver-2"))
    config = load_config(settings, connect=("tls/router:7447",))
    assert (config.maps, config.journal) == ("shard2-*", "/var/lib/factorbus")


@pytest.mark.parametrize("name", ["solver", "worker"])
def test_kernels_are_kept_where_the_root_file_system_cannot_be_written(name: str) -> None:
    """What the image has was compiled for another processor: each node compiles its own, into a volume."""
    yaml = pytest.importorskip("yaml")
    (cache,) = re.findall(r"FACTORBUS_CACHE=(\S+)", (DEPLOY / "docker" / "Dockerfile").read_text())
    documents = list(yaml.safe_load_all((DEPLOY / "kubernetes" / f"{name}.yaml").read_text()))
    (owner,) = (each for each in documents if each["kind"] in ("StatefulSet", "Deployment"))
    pod = owner["spec"]["template"]["spec"]
    kept = {volume["name"] for volume in pod["volumes"] if "emptyDir" in volume}
    kept |= {claim["metadata"]["name"] for claim in owner["spec"].get("volumeClaimTemplates", ())}
    for container in (*pod.get("initContainers", ()), *pod["containers"]):
        assert container["securityContext"]["readOnlyRootFilesystem"]
        mounted = {mount["mountPath"]: mount for mount in container["volumeMounts"]}
        assert mounted[cache]["name"] in kept
        assert not mounted[cache].get("readOnly")


def test_compose_is_of_one_piece() -> None:
    yaml = pytest.importorskip("yaml")
    compose = yaml.safe_load((DEPLOY / "docker" / "compose.yaml").read_text())
    for name, service in compose["services"].items():
        assert {"image", "build"} & set(service), name
        assert set(service.get("depends_on", ())) <= set(compose["services"])
        for volume in service.get("volumes", ()):
            source = volume.split(":")[0]
            if source.startswith("."):  # certificates are made where it is run
                assert source == "./certificates" or (DEPLOY / "docker" / source).exists(), source
            else:
                assert source in compose["volumes"]
    targets = [volume.split(":")[1] for volume in compose["services"]["solver"]["volumes"]]
    assert load_config(DEPLOY / "docker" / "serve.toml", insecure=True).journal in targets
