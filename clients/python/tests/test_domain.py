"""Domains that Rust refuses are refused in Python, in words, and shared memory that is full ends nobody by a signal."""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterator

import iceoryx2 as iox2
import pytest

from roomcast import Domain, Planner, RoomcastError, layouts, ports
from samples import ROOMCAST, private_domain

NOBODY = 65_534


ROOT, NAME, BASE = "ROOMCAST_ROOT", "ROOMCAST_DOMAIN", "XDG_RUNTIME_DIR"
OWN = f"/tmp/roomcast-{os.geteuid()}"


@pytest.mark.parametrize(
    ("given", "root", "name"),
    [
        ({ROOT: "/tmp/rc", NAME: "kitchen", BASE: "/run"}, "/tmp/rc", "kitchen"),
        ({ROOT: "/tmp/rc"}, "/tmp/rc", "roomcast"),
        ({NAME: "kitchen", BASE: "/run"}, "/run/roomcast", "kitchen"),
        ({ROOT: "", BASE: "/run"}, "/run/roomcast", "roomcast"),
        ({BASE: "relative"}, OWN, "roomcast"),
        ({BASE: "/a/base/that/no/address/of/a/socket/holds"}, OWN, "roomcast"),
        ({}, OWN, "roomcast"),
    ],
)
def test_the_environment_names_the_domain(monkeypatch: pytest.MonkeyPatch, given: dict[str, str], root: str, name: str) -> None:
    """The test in Rust has the same environments."""
    for variable in (ROOT, NAME, BASE):
        monkeypatch.delenv(variable, raising=False)
    for variable, value in given.items():
        monkeypatch.setenv(variable, value)
    assert Domain.default_for_user() == Domain(root, name)


@pytest.mark.parametrize("given", [{ROOT: "relative"}, {NAME: ""}, {NAME: "Kitchen"}])
def test_a_domain_that_the_environment_names_is_checked(monkeypatch: pytest.MonkeyPatch, given: dict[str, str]) -> None:
    for variable, value in given.items():
        monkeypatch.setenv(variable, value)
    with pytest.raises(RoomcastError):
        Domain.default_for_user()


@pytest.fixture
def folder() -> Iterator[pathlib.Path]:
    with tempfile.TemporaryDirectory(prefix="rc-", dir="/tmp") as folder:
        yield pathlib.Path(folder)


@pytest.mark.parametrize("name", ["", "Room", "a_b", "a/b", "a*", "a very long name that does not fit", "küche"])
def test_a_name_that_cannot_be_part_of_a_file_name_is_refused(name: str) -> None:
    with pytest.raises(RoomcastError, match=r"domain name .*: use 1 to [0-9]+ characters of a-z, 0-9 and '-'"):
        Domain("/tmp/roomcast-x", name)


@pytest.mark.parametrize("root", ["", "relative", "/tmp/a-path-that-is-much-too-long-for-a-socket", "/tmp/" + "é" * 18])
def test_a_root_that_no_socket_can_have_is_refused(root: str) -> None:
    with pytest.raises(RoomcastError, match="domain root .*: give an absolute path of at most 40 bytes"):
        Domain(root)


def test_a_root_may_be_a_path_of_any_type(folder: pathlib.Path) -> None:
    assert Domain(folder, "x") == Domain(str(folder), "x")
    with private_domain() as inside:
        Domain(pathlib.Path(inside.root), inside.name).open("test")


def test_the_characters_of_a_root_are_those_that_iceoryx2_takes() -> None:
    for character in map(chr, [*range(0x180), 0x20AC, 0x1F600, 0xDCFF]):
        if character == "/":
            continue
        root = f"/tmp/a{character}b"
        try:
            iox2.Path.new(root)
        except Exception:
            with pytest.raises(RoomcastError, match="domain root .* cannot be in it; give a path of ASCII characters"):
                Domain(root)
        else:
            assert Domain(root).root == root


def refused(root: pathlib.Path, words: str) -> None:
    with pytest.raises(RoomcastError, match=words) as error:
        Domain(str(root), "x").open("test")
    assert str(root) in str(error.value)
    assert not list(pathlib.Path("/dev/shm").glob("x-*")), "it joined all the same"


@pytest.mark.parametrize("end", ["", "/"])
def test_a_root_that_is_a_symbolic_link_is_refused(folder: pathlib.Path, end: str) -> None:
    (folder / "real").mkdir(mode=0o700)
    (folder / "link").symlink_to("real")
    with pytest.raises(RoomcastError, match="not a directory .a symbolic link does not count as one.; give the directory itself"):
        Domain(f"{folder}/link{end}", "x").open("test")


def test_a_root_that_is_a_link_to_nowhere_is_refused(folder: pathlib.Path) -> None:
    (folder / "link").symlink_to("nothing")
    refused(folder / "link", "cannot make it: File exists; give a path where this user may make a directory")


def test_a_root_that_is_a_file_is_refused(folder: pathlib.Path) -> None:
    (folder / "file").touch()
    refused(folder / "file", "cannot make it: File exists")


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o770, 0o702, 0o720])
def test_a_root_that_others_may_write_to_is_refused(folder: pathlib.Path, mode: int) -> None:
    (folder / "open").mkdir()
    (folder / "open").chmod(mode)
    refused(folder / "open", rf"others may write there \(mode {mode:o}\): give a folder of your own")


def test_a_root_of_another_user_is_refused(folder: pathlib.Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("SKIPPED: only root can give a directory to another user")
    (folder / "theirs").mkdir(mode=0o700)
    os.chown(folder / "theirs", NOBODY, NOBODY)
    refused(folder / "theirs", f"belongs to user {NOBODY}; .*: run as that user, or use another root")


def test_a_root_that_is_missing_is_made_for_this_user_alone(folder: pathlib.Path) -> None:
    with private_domain() as inside:
        domain = Domain(f"{inside.root}/a", inside.name)
        domain.open("test")
        assert (pathlib.Path(inside.root) / "a").stat().st_mode & 0o777 == 0o700


def test_a_root_in_a_folder_that_does_not_exist_is_refused_with_the_folders_name(folder: pathlib.Path) -> None:
    with pytest.raises(RoomcastError, match=f"does not exist, and neither does {folder}/typo: "):
        Domain(folder / "typo/d")
    (folder / "typo").mkdir()
    domain = Domain(folder / "typo/d")
    (folder / "typo").rmdir()
    with pytest.raises(RoomcastError, match=f"neither does {folder}/typo: "):
        domain.open("test")


def test_what_another_user_put_in_shared_memory_is_refused() -> None:
    if os.geteuid() != 0:
        pytest.skip("SKIPPED: only root can make another user's file")
    with private_domain() as domain:
        planted = pathlib.Path(f"/dev/shm/{domain.prefix}planted")
        planted.touch()
        os.chown(planted, NOBODY, NOBODY)
        with pytest.raises(RoomcastError, match=f"{planted} belongs to user {NOBODY}.*use another domain name"):
            domain.open("test")


def test_nothing_in_shared_memory_is_open_to_others() -> None:
    with private_domain() as domain, Planner("planner", domain):
        files = list(pathlib.Path("/dev/shm").glob(f"{domain.prefix}*"))
        assert files and not [file for file in files if file.stat().st_mode & 0o077]


def test_pipes_and_links_in_shared_memory_hold_up_nobody_and_stay_as_they_are(folder: pathlib.Path) -> None:
    """What anybody may put there under the domain's names, after somebody has joined."""
    victim = folder / "victim"
    with open(victim, "wb") as file:
        file.truncate(64 << 20)
    victim.chmod(0o644)
    with private_domain() as domain:
        planted = {name: pathlib.Path(f"/dev/shm/{domain.prefix}{name}.data") for name in ["evil", "link", "folder", "sparse", "theirs"]}
        node = domain.open("before")
        try:
            os.mkfifo(planted["evil"], 0o666)
            planted["link"].symlink_to(victim)
            planted["folder"].mkdir()
            for name in ["sparse", "theirs"]:
                with open(planted[name], "wb") as file:
                    file.truncate(1 << 20)
                planted[name].chmod(0o644)
            if os.geteuid() == 0:
                os.chown(planted["evil"], NOBODY, NOBODY)
                os.chown(planted["theirs"], NOBODY, NOBODY)
            kept = ports.Publisher(node, ports.DECISION)
            assert victim.stat().st_blocks == 0, "a link was followed"
            assert planted["sparse"].stat().st_blocks * 512 >= 1 << 20
            if os.geteuid() == 0:
                assert planted["theirs"].stat().st_blocks == 0
                with pytest.raises(RoomcastError, match=f"belongs to user {NOBODY}"):
                    domain.open("after")
                os.chown(planted["evil"], 0, 0)
                os.chown(planted["theirs"], 0, 0)
            domain.open("after")
            assert victim.stat().st_mode & 0o777 == 0o644, "a link was followed"
            assert planted["sparse"].stat().st_mode & 0o777 == 0o600
            assert planted["evil"].is_fifo() and planted["folder"].is_dir()
            del kept
        finally:
            planted["folder"].rmdir()


def test_a_participant_is_named_in_the_refusal_of_its_name() -> None:
    with private_domain() as domain:
        domain.open("ä" * 100)
        for length in (101, 300):
            with pytest.raises(
                RoomcastError, match=f"cannot join the domain at {domain.root} as 'a+': a name of {length} characters; give at most 100$"
            ):
                domain.open("a" * length)


def test_a_service_of_another_type_is_refused_at_once() -> None:
    class DecisionV1(layouts.Message):
        _fields_ = layouts.DecisionV1._fields_[:-1]

    other = ports.Service(ports.DECISION.name, DecisionV1, 8, 16, 16, 1)
    with private_domain() as domain:
        kept = ports.Publisher(domain.open("old"), other)
        with pytest.raises(RoomcastError, match="service roomcast/v1/decision: .*IncompatibleTypes.*the same version of Roomcast"):
            ports.Publisher(domain.open("new"), ports.DECISION)
        del kept


def test_places_that_are_taken_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "_OPEN_FOR_S", 0.2)
    with private_domain() as domain:
        node = domain.open("daemon")
        kept = ports.Publisher(node, ports.FORECAST)
        with pytest.raises(RoomcastError, match="service roomcast/v1/forecast: cannot open it: .*places are taken, stop another"):
            ports.Publisher(node, ports.FORECAST)
        del kept


PARTICIPANT = """
    import os, sys
    from roomcast import Domain, Narrator, Planner, RoomcastError

    try:
        planner = Planner("planner", Domain(sys.argv[1], "full"))
    except RoomcastError as error:
        sys.exit(f"in words: {error}")
    # Somebody else takes all that is left.
    with open("/dev/shm/other", "wb", buffering=0) as other:
        try:
            while other.write(bytes(1 << 12)):
                pass
        except OSError as error:
            print(error.strerror)
    for _ in range(100):
        planner.decide("kitchen", "nobody is there")
    try:
        Narrator("narrator", Domain(sys.argv[1], "full"))
    except RoomcastError as error:
        print(f"in words: {error}")
"""


def with_shared_memory(size: str, folder: pathlib.Path) -> subprocess.CompletedProcess[str]:
    """A participant where /dev/shm is a file system of this size."""
    mount = 'mount -t tmpfs -o size="$0" tmpfs /dev/shm && exec "$@"'
    inside = ["unshare", "--map-root-user", "--mount", "sh", "-c", mount]
    if not shutil.which("unshare") or subprocess.run([*inside, "1m", "true"], capture_output=True, check=False).returncode:
        pytest.skip("SKIPPED: this user may not mount the small file system that this needs")
    script = textwrap.dedent(PARTICIPANT)
    return subprocess.run(
        [*inside, size, sys.executable, "-c", script, str(folder / "d")], capture_output=True, text=True, check=False, timeout=60
    )


@pytest.mark.parametrize("size", ["64k", "256k", "1m", "4m", "7m"])
def test_shared_memory_that_is_too_small_is_refused_in_words(folder: pathlib.Path, size: str) -> None:
    ended = with_shared_memory(size, folder)
    assert ended.returncode == 1, ended
    assert ended.stderr.startswith("in words: /dev/shm has ")
    assert "8388608 are needed: remove what fills it, or mount it larger" in ended.stderr


def test_shared_memory_that_fills_up_later_harms_nobody_who_has_joined(folder: pathlib.Path) -> None:
    ended = with_shared_memory("16m", folder)
    assert ended.returncode == 0, ended
    assert "No space left on device" in ended.stdout and "in words: /dev/shm has 0 bytes free" in ended.stdout


def test_rust_refuses_the_same_roots(folder: pathlib.Path) -> None:
    if not ROOMCAST or not pathlib.Path(ROOMCAST).exists():
        pytest.skip("SKIPPED: set ROOMCAST to the built binary")
    (folder / "real").mkdir(mode=0o700)
    (folder / "link").symlink_to("real")
    (folder / "open").mkdir()
    (folder / "open").chmod(0o777)
    (folder / "file").touch()
    for root in ["link", "open", "file"]:
        refused(folder / root, "domain root")
        command = [ROOMCAST, "planner", "--root", str(folder / root), "--domain", "x"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        assert ended.returncode == 6 and "domain root" in ended.stderr, ended
