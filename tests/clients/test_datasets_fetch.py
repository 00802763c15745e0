"""Fetching from a server of raw files: what goes right, and everything that can go wrong on the way."""

import hashlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from dataset_sources import Answer, Site, raw_files

from factorbus.datasets import (
    CATALOGUE,
    Dataset,
    DatasetProblem,
    Places,
    Source,
    convert,
    dataset_named,
    fetch_dataset,
    find,
    locate,
)
from factorbus.datasets.download import download
from factorbus.datasets.errors import (
    BadAddress,
    BadChecksum,
    BrokenDownload,
    CannotWrite,
    DiskFull,
    HttpStatus,
    NotShipped,
    Unreachable,
)

SMALL = b"".join(b"EDGE2 %d %d 1 0 0.5 3 0 0 3 0 4\n" % (i, i + 1) for i in range(40))
LARGE = b"".join(b"EDGE2 %d %d 1 0 0.5 3 0 0 3 0 4\n" % (i, i + 1) for i in range(8000))


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def dataset_of(source: bytes, name: str = "lane", form: str = "isam") -> Dataset:
    """A catalogue entry for a source of our own."""
    origin = Source(form, ("data/lane one.txt",), (sha256(source),), "someone/maps", "c0ffee")
    made = convert(form, [("lane", source)])
    edges = source.count(b"\n")
    return Dataset(name, "a lane", "", "2D", edges + 1, 0, edges, 0, 0, 0.0, sha256(made), origin)


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with raw_files() as site:
        yield site


def serve(site: Site, answer: Answer) -> str:
    """Let the site answer so for the lane; returns the path."""
    site.holds("someone/maps", "c0ffee", "data/lane%20one.txt", answer)
    return "/someone/maps/c0ffee/data/lane%20one.txt"


def left_in(cache: Path) -> list[str]:
    return sorted(str(path.relative_to(cache)) for path in cache.rglob("*"))


def refused(site: Site, cache: Path, kind: type[DatasetProblem], says: str, timeout_s: float = 20) -> DatasetProblem:
    """Fetch, see it fail in one line, with nothing left behind."""
    with pytest.raises(kind, match=says) as caught:
        fetch_dataset(dataset_of(SMALL), cache, base=site.base, timeout_s=timeout_s)
    assert type(caught.value) is kind
    assert "\n" not in caught.value.message
    assert left_in(cache) == []
    return caught.value


def test_a_data_set_is_downloaded_converted_and_put_in_place(site: Site, tmp_path: Path) -> None:
    path = serve(site, Answer(SMALL))
    file = fetch_dataset(dataset_of(SMALL), tmp_path / "new" / "cache", base=site.base + "/")
    assert file == tmp_path / "new" / "cache" / "lane.g2o"
    assert file.read_bytes() == convert("isam", [("lane", SMALL)])
    assert file.read_text().startswith("EDGE_SE2 0 1 1 0 0.5 9 0 0 9 0 16\n")
    assert site.asked == [path]
    assert left_in(tmp_path) == ["new", "new/cache", "new/cache/lane.g2o"]
    assert file.stat().st_mode & 0o777 == 0o666 & ~current_umask()


def current_umask() -> int:
    mask = os.umask(0o22)
    os.umask(mask)
    return mask


def test_what_is_there_and_good_is_not_fetched_again(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL))
    first = fetch_dataset(dataset_of(SMALL), tmp_path, base=site.base)
    before = first.stat().st_ino
    assert fetch_dataset(dataset_of(SMALL), tmp_path, base=site.base).stat().st_ino == before
    assert len(site.asked) == 1


def test_what_is_there_and_bad_is_replaced_but_not_before_the_new_one_is_good(site: Site, tmp_path: Path) -> None:
    (tmp_path / "lane.g2o").write_text("EDGE_SE2 damaged\n")
    with pytest.raises(HttpStatus):
        fetch_dataset(dataset_of(SMALL), tmp_path, base=site.base)
    assert (tmp_path / "lane.g2o").read_text() == "EDGE_SE2 damaged\n"
    serve(site, Answer(SMALL))
    assert sha256(fetch_dataset(dataset_of(SMALL), tmp_path, base=site.base).read_bytes()) == dataset_of(SMALL).sha256
    assert left_in(tmp_path) == ["lane.g2o"]


def test_progress_comes_while_the_file_still_does(site: Site, tmp_path: Path) -> None:
    """The second half is sent only after the first was reported."""
    half_seen = threading.Event()
    serve(site, Answer(LARGE, released=half_seen, head=1 << 17))
    seen: list[tuple[str, int, int | None]] = []

    def watch(file: str, done: int, total: int | None) -> None:
        seen.append((file, done, total))
        half_seen.set()

    fetch_dataset(dataset_of(LARGE), tmp_path, base=site.base, watch=watch)
    counts = [done for _, done, _ in seen]
    assert 0 < counts[0] < len(LARGE)
    assert counts == sorted(counts)
    assert counts[-1] == len(LARGE)
    assert {(file, total) for file, _, total in seen} == {("lane one.txt", len(LARGE))}


def test_a_redirect_is_followed(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(status=302, location="/elsewhere/lane.txt"))
    site.answers["/elsewhere/lane.txt"] = Answer(SMALL)
    assert fetch_dataset(dataset_of(SMALL), tmp_path, base=site.base).is_file()


def test_without_a_length_the_checksum_decides(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL, length=None))
    assert fetch_dataset(dataset_of(SMALL), tmp_path, base=site.base).is_file()
    (tmp_path / "lane.g2o").unlink()
    serve(site, Answer(SMALL[:-20], length=None))
    refused(site, tmp_path, BadChecksum, "not the file of that commit")


def test_another_file_is_refused(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL.replace(b"0.5", b"0.6", 1)))
    problem = refused(site, tmp_path, BadChecksum, r"has SHA-256 [0-9a-f]{16}\.\.\., wanted [0-9a-f]{16}")
    assert problem.code == "bad_checksum"
    assert problem.detail["wanted"] == sha256(SMALL)


def test_a_cut_connection_is_told(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL, length=len(SMALL) + 100))
    says = f"cut after {len(SMALL):,} bytes; wanted {len(SMALL) + 100:,} bytes"
    assert refused(site, tmp_path, BrokenDownload, says).code == "broken_download"


def test_a_length_that_is_too_short_is_told_by_the_checksum(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL, length=len(SMALL) - 1))
    refused(site, tmp_path, BadChecksum, "not the file of that commit")


@pytest.mark.parametrize("status", [404, 403, 500, 503])
def test_a_status_is_told(site: Site, tmp_path: Path, status: int) -> None:
    serve(site, Answer(b"<html>no</html>", status))
    problem = refused(site, tmp_path, HttpStatus, f"answered {status} ")
    assert (problem.code, problem.detail["status"]) == ("http_status", status)


def test_a_redirect_in_circles_is_told(site: Site, tmp_path: Path) -> None:
    path = serve(site, Answer(status=302))
    site.answers[path].location = path
    refused(site, tmp_path, HttpStatus, "answered 302 and sends one elsewhere without end")


def test_what_is_not_http_is_told(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(garbage=True))
    refused(site, tmp_path, BrokenDownload, "not http")


def test_a_server_that_never_answers_is_given_up(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL, released=threading.Event()))
    assert refused(site, tmp_path, Unreachable, r"no answer for 0\.2 s", 0.2).code == "unreachable"


def test_a_server_that_falls_silent_is_given_up(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL, released=threading.Event(), head=100))
    refused(site, tmp_path, Unreachable, r"no answer for 0\.2 s", 0.2)


def test_nobody_there_is_told(site: Site, tmp_path: Path) -> None:
    with raw_files() as gone:
        pass
    refused(Site(gone.base), tmp_path, Unreachable, "refused; check the network")


@pytest.mark.parametrize("base", ["", "mirror.example", "file:///etc", "ftp://mirror.example", "http://", "http://a?b"])
def test_an_address_that_cannot_be_is_refused(tmp_path: Path, base: str) -> None:
    with pytest.raises(BadAddress, match="wanted one such as"):
        fetch_dataset(dataset_of(SMALL), tmp_path / "cache", base=base)
    assert left_in(tmp_path) == []


def test_a_conversion_with_another_outcome_is_refused(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL))
    with pytest.raises(BadChecksum, match=r"lane\.g2o as converted .* conversion is wrong here"):
        fetch_dataset(replace(dataset_of(SMALL), sha256="0" * 64), tmp_path, base=site.base)
    assert left_in(tmp_path) == []


def test_a_source_without_recorded_checksum_is_held_to_the_outcome(site: Site, tmp_path: Path) -> None:
    known = dataset_of(SMALL)
    assert known.download is not None
    unknown = replace(known, download=replace(known.download, sha256=(None,)))
    serve(site, Answer(LARGE))
    with pytest.raises(BadChecksum, match="may be another file"):
        fetch_dataset(unknown, tmp_path, base=site.base)
    serve(site, Answer(SMALL + b"\n# the same in other words\n"))
    assert sha256(fetch_dataset(unknown, tmp_path, base=site.base).read_bytes()) == known.sha256


def test_the_source_is_kept_when_asked_for(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL))
    with pytest.raises(BadChecksum):
        fetch_dataset(replace(dataset_of(SMALL), sha256="0" * 64), tmp_path, base=site.base, keep_source=True)
    assert left_in(tmp_path) == ["sources", "sources/lane", "sources/lane/lane one.txt"]
    assert (tmp_path / "sources/lane/lane one.txt").read_bytes() == SMALL


def test_two_files_of_one_source(site: Site, tmp_path: Path) -> None:
    vertices, edges = b"VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\n", b"EDGE2 1 0 -1 0 0 20 0 20 100 0 0\n"
    source = Source("toro", ("v.dat", "e.dat"), (sha256(vertices), sha256(edges)), "someone/maps", "c0ffee")
    made = convert("toro", [("v.dat", vertices), ("e.dat", edges)])
    pair = Dataset("pair", "a pair", "", "2D", 2, 0, 1, 0, 2, 0.0, sha256(made), source)
    site.holds("someone/maps", "c0ffee", "v.dat", Answer(vertices))
    with pytest.raises(HttpStatus, match=r"e\.dat answered 404"):
        fetch_dataset(pair, tmp_path, base=site.base)
    assert left_in(tmp_path) == []
    site.holds("someone/maps", "c0ffee", "e.dat", Answer(edges))
    assert fetch_dataset(pair, tmp_path, base=site.base).read_bytes() == made


def test_a_cache_that_cannot_be_made_is_told(site: Site, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CannotWrite, match="Not a directory; make the folder writable"):
        fetch_dataset(dataset_of(SMALL), tmp_path / "file" / "cache", base=site.base)
    assert left_in(tmp_path) == ["file"]


def test_a_folder_in_the_place_of_the_file_is_told(site: Site, tmp_path: Path) -> None:
    serve(site, Answer(SMALL))
    (tmp_path / "lane.g2o").mkdir()
    with pytest.raises(CannotWrite, match=r"lane\.g2o cannot be written: Is a directory"):
        fetch_dataset(dataset_of(SMALL), tmp_path, base=site.base)
    assert left_in(tmp_path) == ["lane.g2o"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_disk_is_told_apart_from_the_network(site: Site) -> None:
    path = serve(site, Answer(SMALL))
    with pytest.raises(DiskFull, match="No space left on device; make room") as caught:
        download(site.base + path, Path("/dev/full"))
    assert caught.value.code == "disk_full"


_LIMITED = """
import resource, sys
from pathlib import Path
from factorbus.datasets import Dataset, DatasetProblem, Source, fetch_dataset
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
cache, base, source, made = sys.argv[1:]
lane = Dataset("lane", "", "", "2D", 2, 0, 1, 0, 0, 0.0, made, Source("isam", ("l.txt",), (source,), "a/b", "c"))
try:
    fetch_dataset(lane, Path(cache), base=base)
except DatasetProblem as problem:
    print(problem.code)
"""


def test_no_room_while_downloading_leaves_nothing(site: Site, tmp_path: Path) -> None:
    """A process that may write files of 100 kB only."""
    site.holds("a/b", "c", "l.txt", Answer(LARGE))
    known = dataset_of(LARGE)
    ran = subprocess.run(
        [sys.executable, "-c", _LIMITED, str(tmp_path), site.base, sha256(LARGE), known.sha256],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert ran.stdout == "disk_full\n"
    assert left_in(tmp_path) == []


def test_what_only_the_wheel_has_needs_the_wheel(tmp_path: Path) -> None:
    shipped = Source("isam", ("lane.txt",), (sha256(SMALL),))
    lane = replace(dataset_of(SMALL), download=None, wheel=shipped)
    with pytest.raises(NotShipped, match=r"pip install 'gtsam==4\.3\.0'"):
        fetch_dataset(lane, tmp_path / "cache")
    wheel = tmp_path / "wheel"
    wheel.mkdir()
    (wheel / "lane.txt").write_bytes(SMALL)
    assert sha256(fetch_dataset(lane, tmp_path / "cache", wheel=wheel).read_bytes()) == lane.sha256


def test_the_wheels_file_is_taken_before_the_network_unless_it_is_another(site: Site, tmp_path: Path) -> None:
    lane = replace(dataset_of(SMALL), wheel=Source("isam", ("lane.txt",), (sha256(SMALL),)))
    (tmp_path / "lane.txt").write_bytes(SMALL)
    fetch_dataset(lane, tmp_path / "one", wheel=tmp_path, base=site.base)
    assert site.asked == []
    (tmp_path / "lane.txt").write_bytes(LARGE)
    path = serve(site, Answer(SMALL))
    fetch_dataset(lane, tmp_path / "two", wheel=tmp_path, base=site.base)
    assert site.asked == [path]


def test_found_in_the_users_folder_then_the_cache_then_the_wheel(tmp_path: Path) -> None:
    lane = replace(dataset_of(SMALL), wheel=Source("isam", ("lane.txt",), (sha256(SMALL),)))
    places = Places(tmp_path / "own", tmp_path / "cache", tmp_path / "wheel")
    assert locate(lane, places) is None
    assert find("lane", places, [lane]) is None

    (tmp_path / "wheel").mkdir()
    (tmp_path / "wheel" / "lane.txt").write_bytes(LARGE)
    assert find("lane", places, [lane]) is None, "another file of that name is not it"
    (tmp_path / "wheel" / "lane.txt").write_bytes(SMALL)
    assert str(locate(lane, places)).count("wheel") >= 1
    assert not (tmp_path / "cache").exists(), "looking changes nothing"
    assert find("lane", places, [lane]) == tmp_path / "cache" / "lane.g2o"
    assert sha256((tmp_path / "cache" / "lane.g2o").read_bytes()) == lane.sha256

    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "lane.g2o").write_text("the user's")
    assert find("lane.g2o", places, [lane]) == tmp_path / "own" / "lane.g2o"


def test_the_places_of_this_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.delenv("FACTORBUS_DATASETS", raising=False)
    assert Places.of_this_machine().cache == tmp_path / ".cache" / "factorbus" / "datasets"
    assert Places.of_this_machine().own is None
    monkeypatch.setenv("XDG_CACHE_HOME", "/elsewhere")
    monkeypatch.setenv("FACTORBUS_DATASETS", "~/maps")
    assert Places.of_this_machine().cache == Path("/elsewhere/factorbus/datasets")
    assert Places.of_this_machine().own == tmp_path / "maps"


def test_looking_for_the_wheel_does_not_import_it() -> None:
    code = (
        "import sys, factorbus.datasets as d; d.find('intel'); sys.exit(int(bool({'gtsam', 'numpy'} & {*sys.modules})))"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0


def test_every_entry_of_the_catalogue_can_be_had() -> None:
    assert [each.paper for each in CATALOGUE if each.paper] == [
        "Manhattan", "10k", "CityTrees10k", "Intel", "Killian", "Victoria Park",
    ]  # fmt: skip
    assert len({each.name for each in CATALOGUE}) == len(CATALOGUE) == 11
    for each in CATALOGUE:
        assert dataset_named(each.file, CATALOGUE) is each
        assert each.download is not None
        assert len(each.download.commit) == 40
        assert len(each.download.paths) == len(each.download.sha256)
        for checksum in (each.sha256, *each.download.sha256, *(each.wheel.sha256 if each.wheel else ())):
            assert checksum is None or (len(checksum) == 64 and int(checksum, 16) > 0)
