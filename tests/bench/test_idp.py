"""The bench of inverse-depth features: the paper's numbers, what its targets are, and real tracks."""

from pathlib import Path

import numpy as np
import pytest
from bench import idp, idp_euroc, idp_paper, idp_times

from factorbus.idp import minimal, see
from factorbus.proto.camera import Camera
from factorbus.proto.features import Observations


def test_the_paper_s_tables_and_figures() -> None:
    found = idp_paper.tables()
    assert [row["J"] for row in found["table_1"]] == [(19, 16), (25, 22), (31, 28)]
    assert found["figure_5"] == [4864 + 5776, 12100 + 13750, 24304 + 26908]
    assert found["table_2"][1] == ["1014", "468+54+108", "468", "468"]
    assert sum(found["figure_8"].values()) == 10_782
    assert {row["features"]: row["classical"] for row in found["figure_10"]}[3] == 87_702


def test_figures_are_drawn(tmp_path: Path) -> None:
    paths = idp_paper.draw(tmp_path, idp_paper.tables())
    assert [path.name for path in paths] == ["idp_figure_5.png", "idp_figure_8.png", "idp_figure_10.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


def test_rows_and_targets(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of it but the sizes that take their time and the processes."""
    monkeypatch.setattr(idp, "_SIZES", ((3, 0), (100, 0), (1000, 0)))
    monkeypatch.setattr(idp_times, "_BUDGET_S", 0.05)
    real = idp_times.rows
    monkeypatch.setattr(idp_times, "rows", lambda n, existing: real(n, existing) if n < 100 else large(n))
    found = idp.run(workers=False)
    wanted = {"features", "existing", "method", "multiplications", "seconds", "workers", "extrapolated"}
    assert all(set(row) == wanted for row in found["rows"])
    assert {row["method"] for row in found["rows"]} >= set(idp._METHODS)
    met = {target["target"]: target["met"] for target in found["targets"]}
    assert met["multiplications for 3 features, classical"]
    assert met["multiplications for 3 features, independent"]
    assert not met["independent is faster than classical, n = 100"], "all took a second"
    assert "Table 2: independent" in idp.report(found)


def large(n: int) -> list[dict]:
    row = {"features": n, "existing": 0, "multiplications": 1, "seconds": 1.0, "workers": 0, "extrapolated": False}
    return [{**row, "method": method} for method in idp._METHODS]


def test_a_similarity_is_undone() -> None:
    rng = np.random.default_rng(1)
    truth = rng.normal(size=(50, 3))
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    R *= np.linalg.det(R)
    way = (truth - [1.0, 2.0, 3.0]) @ R / 2.5
    aligned, scale = idp_euroc.similar(way, truth)
    np.testing.assert_allclose(aligned, truth, atol=1e-12)
    assert scale == pytest.approx(2.5)


class Near:
    """Features made in this process."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera

    def grow(self, x: np.ndarray, P: np.ndarray, pixels: np.ndarray):
        from factorbus.client.filter_state import FilterState

        observations = Observations(self.camera, x[:13], P[:13], pixels, idp_euroc._RHO, idp_euroc._SIGMA_RHO, 2.5)
        seen = see(observations)
        after = minimal.covariance(P, observations, seen).P
        return FilterState(np.concatenate([x, seen.y.reshape(-1)]), after, seen.y, ("here",), 0.0)


def test_real_tracks_with_their_outliers_give_the_trajectory(datasets: Path) -> None:
    folder = datasets / "monocular" / "euroc_v101"
    visual, way = idp_euroc.drive(folder, Near(idp_euroc.camera_of(folder)))  # type: ignore[arg-type]
    truth = np.loadtxt(folder / "poses.txt")
    truth = truth[np.isin(truth[:, 0], way[:, 0])]
    aligned, _ = idp_euroc.similar(way[np.isin(way[:, 0], truth[:, 0]), 1:4], truth[:, 2:5])
    error = np.sqrt((np.linalg.norm(aligned - truth[:, 2:5], axis=1) ** 2).mean())
    assert error < 0.15, f"{error:.3f} m of 3.1"
    assert visual.counts["wrong"] > 0
