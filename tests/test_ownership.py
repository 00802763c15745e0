"""What others can write to is not trusted: the kernel cache, which is code, and journals.  What is made is private."""

import json
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from factorbus.cli.doctor.checks import CHECKS, cache
from factorbus.cli.output.exits import FAILED, REFUSED
from factorbus.journal.bundle import export_map, import_map
from factorbus.journal.checkpoints import file_of, write_checkpoint
from factorbus.journal.lock import own
from factorbus.journal.problems import UnsafeJournal
from factorbus.journal.store import create, open_store
from factorbus.ownership import (
    UnsafeFolder,
    check_file,
    check_folder,
    check_settings_file,
    folders,
    make_private,
    why_unsafe,
)

ANOTHER = 4242
SNEAK = "import fcntl, sys; fcntl.flock(open(sys.argv[1]), fcntl.LOCK_EX | fcntl.LOCK_NB); print('taken')"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "folder"
    made.mkdir(mode=0o700)
    return made


@pytest.fixture
def reachable() -> Iterator[Path]:
    """A folder that other users get to."""
    made = Path(tempfile.mkdtemp())
    made.chmod(0o755)
    yield made
    shutil.rmtree(made)


def give_away(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It belongs to somebody else: really where we may, else we are somebody else."""
    if os.geteuid() == 0:
        os.chown(path, ANOTHER, ANOTHER)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: ANOTHER)


@pytest.mark.parametrize("mode", [0o700, 0o750, 0o755, 0o711])
def test_what_only_we_can_write_to_is_safe(folder: Path, mode: int) -> None:
    folder.chmod(mode)
    assert why_unsafe(folder) == ("", "")


@pytest.mark.parametrize(("mode", "who"), [(0o770, "group"), (0o775, "group"), (0o777, "everybody"), (0o702, "every")])
def test_what_others_can_write_to_is_not(folder: Path, mode: int, who: str) -> None:
    folder.chmod(mode)
    reason, _ = why_unsafe(folder)
    if mode & 0o007 in (0o7, 0o2) or folder.stat().st_uid != 0:  # a group of root's own may have a folder of root's
        assert who in reason
        with pytest.raises(UnsafeFolder, match="chmod go-w") as raised:
            check_folder("the cache", folder)
        assert (raised.value.code, raised.value.detail["folder"]) == ("unsafe_folder", str(folder))


def test_the_command_that_mends_a_folder_can_be_pasted(folder: Path) -> None:
    spaced = folder / "my maps"
    spaced.mkdir()
    spaced.chmod(0o777)
    assert why_unsafe(spaced)[1].startswith(f"chmod go-w '{spaced}'")


def test_what_belongs_to_another_is_not(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    give_away(folder, monkeypatch)
    with pytest.raises(UnsafeFolder, match="it belongs to user"):
        check_folder("the cache", folder)


def status(owner: int, group: int, mode: int) -> os.stat_result:
    return os.stat_result((mode, 0, 0, 1, owner, group, 0, 0, 0, 0))


@pytest.mark.parametrize(
    ("owner", "group", "mode", "safe"),
    [
        (0, 10001, 0o2775, True),  # a volume of Kubernetes with fsGroup
        (0, 10001, 0o2777, False),  # emptyDir
        (0, 5, 0o2775, False),  # of a group that is not ours
        (ANOTHER, 10001, 0o2775, False),  # ours: there is no need for it
        (ANOTHER, 10001, 0o755, True),
        (7, 10001, 0o700, False),
    ],
)
def test_volumes_of_containers(
    owner: int, group: int, mode: int, safe: bool, monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: ANOTHER)
    reason, _ = folders.why_unsafe_itself(folder, status(owner, group, mode), {10001})
    assert (reason == "") is safe, reason


def test_nobody_can_write_to_what_is_mounted_read_only(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.chmod(0o777)
    assert why_unsafe(folder)[0]
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_flag=os.ST_RDONLY))
    assert why_unsafe(folder) == ("", "")


def test_a_folder_that_can_be_replaced_is_not_safe(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inner = folder / "a" / "b"
    make_private("the cache", inner)
    assert [stat.S_IMODE(each.stat().st_mode) for each in (inner, inner.parent)] == [0o700, 0o700]
    folder.chmod(0o777)
    with pytest.raises(UnsafeFolder, match=f"it is in {folder}, which everybody can write to"):
        check_folder("the cache", inner)
    link = folder.parent / "link"
    link.symlink_to(inner)
    with pytest.raises(UnsafeFolder, match="which everybody can write to"):
        check_folder("the cache", link)
    folder.chmod(0o1777)  # as /tmp is
    check_folder("the cache", inner)
    folder.chmod(0o700)
    give_away(folder, monkeypatch)
    with pytest.raises(UnsafeFolder, match="belongs to user"):
        check_folder("the cache", inner)


def test_a_folder_above_that_another_group_can_write_to_is_not_safe(folder: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root gives a folder to a group that it is not in")
    inner = folder / "own"
    inner.mkdir(mode=0o700)
    folder.chmod(0o775)
    assert why_unsafe(inner) == ("", "")  # of a group of ours
    os.chown(folder, 0, ANOTHER)
    with pytest.raises(UnsafeFolder, match=f"which group {ANOTHER} can write to"):
        check_folder("the cache", inner)
    folder.chmod(0o1775)
    assert why_unsafe(inner) == ("", "")


def test_a_mount_point_may_be_open(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inner = folder / "own"
    inner.mkdir(mode=0o700)
    folder.chmod(0o777)
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) in (folder, Path("/")))
    assert why_unsafe(inner) == ("", "")


def test_files_of_others_are_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = folder / "kernel"
    file.write_bytes(b"code")
    check_file("the kernel", file, file.stat())
    file.chmod(0o664)
    with pytest.raises(UnsafeFolder, match="group"):
        check_file("the kernel", file, file.stat())
    file.chmod(0o600)
    give_away(file, monkeypatch)
    with pytest.raises(UnsafeFolder, match="belongs to user"):
        check_file("the kernel", file, file.stat())


def test_settings_that_others_can_write_to_are_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = folder / "serve.toml"
    file.write_text("")
    for mode in (0o600, 0o644, 0o664):  # 0o664: writable by a group of this process, as umask 002 leaves it
        file.chmod(mode)
        check_settings_file("the settings", file)
    file.chmod(0o646)
    with pytest.raises(UnsafeFolder, match="everybody can write to it"):
        check_settings_file("the settings", file)
    file.chmod(0o644)
    folder.chmod(0o777)
    with pytest.raises(UnsafeFolder, match=r"it is in .*, which everybody can write to"):
        check_settings_file("the settings", file)
    folder.chmod(0o1777)
    check_settings_file("the settings", file)
    give_away(file, monkeypatch)
    with pytest.raises(UnsafeFolder, match="belongs to user"):
        check_settings_file("the settings", file)


def test_settings_from_a_pipe_and_those_that_are_missing_are_for_who_reads_them(folder: Path) -> None:
    os.mkfifo(folder / "pipe", 0o666)
    for path in (folder / "pipe", folder / "missing", folder):
        check_settings_file("the settings", path)


def test_a_service_and_a_gateway_do_not_begin_with_them(folder: Path) -> None:
    for name, text, command in (
        ("serve.toml", "", ("serve", "--config")),
        ("people.toml", f'[operator]\nann = "{"a" * 20}"\n', ("gateway", "--connect", "tcp/127.0.0.1:9", "--people")),
    ):
        file = folder / name
        file.write_text(text)
        file.chmod(0o666)
        ran = factorbus(*command, str(file))
        assert ran.returncode == REFUSED, ran.stderr
        assert f"{file} is not used: everybody can write to it" in ran.stderr
        assert "[unsafe_folder]" in ran.stderr


def factorbus(*words: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-P", "-m", "factorbus.cli", *words], env=os.environ | environment, capture_output=True,
        text=True, timeout=250, check=False,
    )  # fmt: skip


def test_the_doctor_takes_a_volume_that_everybody_may_mount_as_the_service_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An emptyDir is 0777; kernels are in folders of the user's own in it."""
    volume = tmp_path / "volume"
    volume.mkdir()
    volume.chmod(0o777)
    monkeypatch.setenv("FACTORBUS_CACHE", str(volume))
    assert cache().state == "fail"
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) in (volume, Path("/")))
    assert cache().seen.endswith(": empty")
    inside = volume / "kernels" / "0123"
    make_private("kernels", inside)
    inside.chmod(0o777)
    assert (cache().state, str(inside) in cache().seen) == ("fail", True)


def test_a_cache_that_others_can_write_to_is_refused_and_the_doctor_says_so(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.chmod(0o777)
    ran = factorbus("warm", FACTORBUS_CACHE=str(folder))
    assert ran.returncode == REFUSED, ran.stderr
    assert "[unsafe_folder]" in ran.stderr
    assert "Traceback" not in ran.stderr
    monkeypatch.setenv("FACTORBUS_CACHE", str(folder))
    finding = cache()
    assert (finding.state, str(folder) in finding.seen) == ("fail", True)
    ran = factorbus("doctor", "--json", FACTORBUS_CACHE=str(folder))
    checks = {check["name"]: check for check in json.loads(ran.stdout)["checks"]}
    assert (ran.returncode, checks["kernel cache"]["state"], checks["bus"]["state"]) == (FAILED, "fail", "fail"), ran
    assert (checks["numba"]["state"], checks["numba"]["mend"]) == ("warn", "see kernel cache")
    assert len(checks) == len(CHECKS)
    folder.chmod(0o700)
    assert cache().state == "warn"  # empty
    inner = folder / "kernels" / "0123"
    make_private("the cache", inner)
    inner.chmod(0o777)
    assert cache().state == "fail"


def private(folder: Path) -> bool:
    return not any(stat.S_IMODE(path.stat().st_mode) & 0o077 for path in [folder, *folder.rglob("*")])


def test_journals_are_for_their_owner_alone(folder: Path) -> None:
    umask = os.umask(0)
    try:
        owned = own(folder / "maps")
        assert owned is not None
        store = create(folder / "maps" / "m", "m", "inc-l", {}, 77, "commit")
        write_checkpoint(file_of(folder / "maps" / "m", 1), {"a": 1})
        assert private(folder / "maps")
        store.close()
        export_map(folder / "maps" / "m", folder / "m.fbmap")
        import_map(folder / "m.fbmap", folder / "others" / "m")
        assert private(folder / "others")
        assert stat.S_IMODE((folder / "m.fbmap").stat().st_mode) == 0o600
        owned.release()
    finally:
        os.umask(umask)


def test_a_journal_that_others_can_write_to_is_not_opened(folder: Path) -> None:
    create(folder / "m", "m", "inc-l", {}, 77, "commit").close()
    (folder / "m").chmod(0o777)
    with pytest.raises(UnsafeJournal) as raised:
        open_store(folder / "m")
    assert raised.value.code == "unsafe_folder"
    open_store(folder / "m", read_only=True).close()  # to look at it
    folder.chmod(0o777)
    for attempt in (lambda: own(folder), lambda: create(folder / "n", "n", "inc-l", {}, 1, "commit")):
        with pytest.raises(UnsafeJournal):
            attempt()
    assert not (folder / "n").exists()


def test_a_service_says_so_and_does_not_start(folder: Path) -> None:
    folder.chmod(0o777)
    ran = factorbus("serve", "--listen", "tcp/127.0.0.1:0", "--no-warm", "--journal", str(folder))
    assert ran.returncode == REFUSED, ran.stderr
    assert "[unsafe_folder]" in ran.stderr
    assert "Traceback" not in ran.stderr


@pytest.mark.parametrize("older", [False, True])
def test_another_user_cannot_take_the_lock(reachable: Path, older: bool) -> None:
    """Not even in a folder that everybody can look into, nor of a file that an older version made."""
    if older:
        (reachable / "owner.lock").touch(0o644)
    owned = own(reachable)
    assert owned is not None
    owned.release()
    lock = reachable / "owner.lock"
    assert stat.S_IMODE(lock.stat().st_mode) == 0o600
    if os.geteuid() == 0:
        tried = subprocess.run(
            ["/usr/bin/env", "python3", "-c", SNEAK, str(lock)], user=ANOTHER, group=ANOTHER, extra_groups=[],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        assert "PermissionError" in tried.stderr, tried
        assert "taken" not in tried.stdout
    again = own(reachable)
    assert again is not None, "the service starts"
    again.release()
