"""A batch optimum whose search ended before it had converged: solver, service and client all say so."""

import json
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import needs_browser, page_of
from processes import Process, processes

from factorbus.client import Changes, Draft, Map, connect

IMPATIENT = str(Path(__file__).parents[1] / "faulty" / "impatient.py")
POSES = 16
SAID = "not converged, the true optimum may be lower"


@pytest.fixture(scope="module")
def spawned(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Process]]:
    with processes(tmp_path_factory.mktemp("impatient")) as start:
        yield start


@pytest.fixture(scope="module")
def impatient(spawned: Callable[..., Process]) -> str:
    """A service without workers, which finds optima itself, and gives up after one try."""
    return spawned(IMPATIENT, "factorbus.service", "--listen", "tcp/127.0.0.1:0").ready()[0]


def wound() -> Draft:
    """A ring of relative poses that do not quite agree, whose values are wound once too often: a worse minimum."""
    rng, draft = np.random.default_rng(5), Draft().se2("x0", (0, 0, 0), fixed=True)
    turn = 2 * np.pi / POSES
    for i in range(1, POSES):
        draft.se2(f"x{i}", (0, 0, float(np.angle(np.exp(2j * turn * i)))))
    step = np.array([np.cos(turn / 2) * 2 * np.sin(turn / 2), 2 * np.sin(turn / 2) ** 2, turn])
    for i in range(POSES):
        measured = step + rng.normal(size=3) * (0.1, 0.1, 0.1)
        draft.between_se2(f"x{i}", f"x{(i + 1) % POSES}", tuple(measured), sigmas=(0.1, 0.1, 0.1))
    return draft


def filled(joined: Map) -> None:
    joined.insert(wound(), settle=True)
    joined.wait_converged(60)


def cli(*arguments: str) -> str:
    """What it says, in one line."""
    command = [sys.executable, "-m", "factorbus.cli", *arguments]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert ran.returncode == 0, ran.stderr
    return " ".join(ran.stdout.split())


def test_in_place_and_by_a_worker_it_is_told(endpoint: str, impatient: str, spawned: Callable[..., Process]) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("patient") as joined:
        filled(joined)
        whole = joined.chi2(batch=True)
        assert whole.batch_converged
        assert whole.batch is not None
    with connect(impatient, client="robot", timeout_s=60) as bus, bus.map("early") as joined:
        filled(joined)
        early = joined.chi2(batch=True)
        assert (early.worker, early.batch_converged) == ("in-place", False)
        assert early.batch > 1.0001 * whole.batch, "the true one is lower"
        assert early.notice is not None, "it is better than the map all the same"
        worker = spawned(IMPATIENT, "factorbus.workers", "--connect", impatient, "--name", "w")
        worker.ready()
        helped = joined.chi2(batch=True)
        for _ in range(100):  # the service hears of a worker a moment after it is ready
            if helped.worker == "w":
                break
            helped = joined.chi2(batch=True)
        assert (helped.worker, helped.batch, helped.batch_converged) == ("w", early.batch, False)


def test_the_command_line_and_the_gateway_say_it(impatient: str, spawned: Callable[..., Process]) -> None:
    with connect(impatient, client="robot", timeout_s=60) as bus, bus.map("told") as joined:
        filled(joined)
        at = ("--connect", impatient)
        told = cli("ask", "chi2", "told", "--batch", *at)
        assert told.count(SAID) == 2, "beside the optimum, and beside the ratio to it"
        assert "better_optimum" in told
        document = json.loads(cli("ask", "chi2", "told", "--batch", "--json", *at))
        assert document["batch_converged"] is False
        (address,) = spawned("-m", "factorbus.cli", "gateway", *at, "--port", "0").ready()
        with urllib.request.urlopen(f"{address}/api/maps/told/optimum", timeout=60) as answer:
            assert json.load(answer)["batch_converged"] is False
        assert SAID in cli("change", "adopt", "told", *at)
        # It has been adopted and settled: from there the search has converged after one try.
        found = json.loads(cli("change", "adopt", "told", "--json", *at))
        assert (found["adopted"], found["batch_converged"]) == (False, True)
        told = cli("ask", "chi2", "told", "--batch", *at) + cli("change", "adopt", "told", *at)
        assert "not converged" not in told


@needs_browser
def test_the_page_says_it(impatient: str, spawned: Callable[..., Process]) -> None:
    with connect(impatient, client="robot", timeout_s=60) as bus, bus.map("shown") as joined:
        filled(joined)
        (address,) = spawned("-m", "factorbus.cli", "gateway", "--connect", impatient, "--port", "0").ready()
        with page_of(f"{address}/#shown") as page:
            page.wait_for_function("window.factorbus.revision >= 1", timeout=60_000)
            page.click("#compare")
            page.wait_for_function("document.querySelectorAll('#panel p').length === 3", timeout=60_000)
            assert "ended before it had converged: the true optimum may be lower" in page.inner_text("#panel")
            joined.change(Changes().adopt(joined.chi2(batch=True, values=True)), settle=True)
            page.click("#compare")
            page.wait_for_function(
                "document.getElementById('panel').textContent.includes('The map is where the optimum is.')",
                timeout=60_000,
            )
            assert "converged" not in page.inner_text("#panel")
