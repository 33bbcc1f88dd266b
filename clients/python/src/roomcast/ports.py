"""Domains, publishers, subscribers and questions with the settings and the checks of `roomcast-ipc`."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import errno
import math
import os
import pathlib
import re
import stat
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import iceoryx2 as iox2

from . import layouts

T = TypeVar("T")

_EVENTS = {"data": 1, "created": 2, "dropped": 3, "dead": 4}
_MAX_NODES = 32
# Spare places for notifiers of killed processes, as in the Rust crate.
_LEFT_BEHIND = 64
# Longest prefix of file names and longest root path, in bytes: with iceoryx2's endings they must fit a Unix socket's address.
_PREFIX_LIMIT = 25
_ROOT_LIMIT = 40
# Characters that iceoryx2 refuses in paths.
_NO_ROOT = re.compile(r'[^ -\x7f]|["*<>?|]')
# Longest display name in characters: iceoryx2 accepts hardly more.
_PARTICIPANT_LIMIT = 100
_SHARED_MEMORY = pathlib.Path("/dev/shm")
# The ending of iceoryx2's counter of participants.
_COUNTER_FILE = ".global_mgmt"
# More than the largest port needs. iceoryx2 maps memory before the system provides it; touching a missing page ends the process by SIGBUS.
_FREE_BYTES = 8 << 20
# Retry time for opening a service: a peer that starts, stops or has just died blocks it only for moments.
_OPEN_FOR_S = 5.0
# The shortest wait: a listener takes less than a microsecond for no limit, and waits for ever.
_MOMENT_S = 0.001
# Time that a publisher stays after its last message, so that woken subscribers can take it.
_LINGER_S = 0.1
# Words in iceoryx2's errors that a retry does not help.
_FINAL = ("Incompatible", "DoesNotSupport", "VersionMismatch", "InsufficientPermissions")


@dataclass(frozen=True)
class Service:
    """A service with its quality of service; all participants must state the same."""

    name: str
    payload: type[layouts.Message]
    publishers: int
    subscribers: int
    buffer: int
    history: int


NARRATION = Service("roomcast/v1/narration", layouts.NarrationV1, 8, 4, 256, 32)
ROOM_SCORES = Service("roomcast/v1/room-scores", layouts.RoomScoresV1, 1, 16, 2, 1)
PERSON_SCORES = Service("roomcast/v1/person-scores", layouts.PersonScoresV1, 1, 16, 2, 1)
FORECAST = Service("roomcast/v1/forecast", layouts.ForecastV1, 1, 16, 2, 1)
PERSON_FORECASTS = Service("roomcast/v1/person-forecasts", layouts.PersonForecastsV1, 1, 16, 2, 1)
DECISION = Service("roomcast/v1/decision", layouts.DecisionV1, 8, 16, 16, 1)
ROBOT_REPORT = Service("roomcast/v1/robot-report", layouts.RobotReportV1, 8, 8, 64, 8)
ITEM_SCORES = "roomcast/v1/item-scores"
STATUS = "roomcast/v1/status"
MAP_CHANGE = "roomcast/v1/map-change"
MOMENT = "roomcast/v1/moment"
PERSON = "roomcast/v1/person"
HABITS = "roomcast/v1/habits"


class RoomcastError(Exception):
    """A domain or a service cannot be used; the message gives the reason and the remedy."""


class NoAnswerError(RoomcastError):
    """There was no answer in time."""


class ClosedError(RoomcastError):
    """The object was closed, by `close` or by the end of a `with` block."""


@dataclass(frozen=True)
class Domain:
    """A private space of services: participants with the same root directory and name see only one another.

    The root (at most 40 bytes, absolute) belongs to one user, and no other user may write there. The name has characters of a-z, 0-9 and '-':
    15 for every user, up to 22 if the user's number is short. The first participant creates the root; its parent folder must exist.
    RoomcastError if either is invalid.
    """

    root: str
    name: str

    def __init__(self, root: str | os.PathLike[str], name: str = "roomcast") -> None:
        # The way to set fields of a frozen dataclass.
        object.__setattr__(self, "root", os.fsdecode(root))
        object.__setattr__(self, "name", name)
        if not os.path.isabs(self.root) or len(os.fsencode(self.root)) > _ROOT_LIMIT:
            raise self._bad_root(f"give an absolute path of at most {_ROOT_LIMIT} bytes (a Unix socket's address must hold it)")
        if refused := _NO_ROOT.search(self.root):
            raise self._bad_root(f"{refused[0]!r} cannot be in it; give a path of ASCII characters without control characters and \"*<>?|")
        plain = all(character in "abcdefghijklmnopqrstuvwxyz0123456789-" for character in self.name)
        most = _PREFIX_LIMIT - len(f"-{os.geteuid():x}_")
        if not plain or not 1 <= len(self.name) <= most:
            raise RoomcastError(f"domain name {self.name!r}: use 1 to {most} characters of a-z, 0-9 and '-'")
        if not os.path.isdir(self._parent):
            raise self._missing()

    @staticmethod
    def default_for_user() -> Domain:
        """The default domain of all commands.

        ROOMCAST_ROOT and ROOMCAST_DOMAIN set it, as for every command; without them the root is under XDG_RUNTIME_DIR, else /tmp/roomcast-UID.
        """
        name = os.environ.get("ROOMCAST_DOMAIN", "roomcast")
        if given := os.environ.get("ROOMCAST_ROOT"):
            return Domain(given, name)
        base = os.environ.get("XDG_RUNTIME_DIR", "")
        root = os.path.join(base, "roomcast")
        if not os.path.isabs(root) or len(os.fsencode(root)) > _ROOT_LIMIT:
            root = f"/tmp/roomcast-{os.geteuid()}"
        return Domain(root, name)

    @staticmethod
    def for_user() -> Domain:
        """As `default_for_user`."""
        return Domain.default_for_user()

    @property
    def prefix(self) -> str:
        """The prefix of all its files' names. Prefixes of two domains, by name or user, never begin each other."""
        return f"{self.name}-{os.geteuid():x}_"

    def open(self, participant: str) -> Node:
        """Joins under a display name (at most 100 characters); creates the root directory if it is missing."""
        if not any(character.isalnum() for character in participant):
            raise RoomcastError(f"participant {participant!r}: give a name with a letter or digit, such as 'hall-camera'")
        if len(participant) > _PARTICIPANT_LIMIT:
            raise RoomcastError(
                f"cannot join the domain at {self.root} as {participant!r}: a name of {len(participant)} characters; give at most "
                f"{_PARTICIPANT_LIMIT}"
            )
        self._prepare_root()
        self._refuse_foreign_shared_memory()
        refuse_full_shared_memory()
        iox2.set_log_level(iox2.LogLevel.Fatal)
        # iceoryx2's names are ASCII only.
        shown = "".join(character if " " <= character <= "~" else "?" for character in participant)
        try:
            config = iox2.config.default()
            config.global_cfg.root_path = iox2.Path.new(self.root)
            config.global_cfg.prefix = iox2.FileName.new(self.prefix)
            builder = iox2.NodeBuilder.new().name(iox2.NodeName.new(shown)).config(config)
            # Python keeps handling Ctrl-C.
            node = builder.signal_handling_mode(iox2.SignalHandlingMode.Disabled).create(iox2.ServiceType.Ipc)
        except Exception as error:  # iceoryx2's bindings have an exception type per operation
            raise RoomcastError(
                f"cannot join the domain at {self.root} as {participant!r}: {error!r}; is {self.root} writable and has /dev/shm space "
                "left?"
            ) from error
        self._close_to_others()
        return Node(node, self)

    def commit_shared_memory(self) -> None:
        """Allocates every page of the domain's shared memory now, so that memory cannot run out in the middle of a publish."""
        for file in self._shared_memory():
            descriptor = _open_own(file, os.O_WRONLY)
            if descriptor is None:
                continue  # it is gone again, being made, or not ours
            size = 0
            try:
                size = os.fstat(descriptor).st_size
                if size:
                    os.posix_fallocate(descriptor, 0, size)
            except OSError as error:
                if error.errno == errno.ENOSPC:
                    raise RoomcastError(
                        f"{file}: {_SHARED_MEMORY} has no room for its {size} bytes: remove what fills it, or mount it larger"
                    ) from error
            finally:
                os.close(descriptor)

    def _bad_root(self, problem: str) -> RoomcastError:
        return RoomcastError(f"domain root {self.root!r}: {problem}")

    @property
    def _parent(self) -> str:
        return os.path.dirname(self.root.rstrip("/")) or "/"

    def _missing(self) -> RoomcastError:
        return self._bad_root(
            f"it does not exist, and neither does {self._parent}: give the root of the running daemon, or make {self._parent}"
        )

    def _prepare_root(self) -> None:
        """Creates the root, or refuses one that other users could write to."""
        root = pathlib.Path(self.root)
        try:
            if not root.is_dir():
                root.mkdir(mode=0o700, exist_ok=True)
            about = root.lstat()
        except FileNotFoundError as error:
            raise self._missing() from error
        except OSError as error:
            raise self._bad_root(f"cannot make it: {error.strerror}; give a path where this user may make a directory") from error
        if not stat.S_ISDIR(about.st_mode):
            raise self._bad_root("not a directory (a symbolic link does not count as one); give the directory itself")
        if about.st_uid != os.geteuid():
            raise self._bad_root(
                f"belongs to user {about.st_uid}; all participants run as one user: run as that user, or use another root"
            )
        if about.st_mode & 0o022:
            raise self._bad_root(
                f"others may write there (mode {stat.S_IMODE(about.st_mode):o}): give a folder of your own, which is made; "
                "or chmod go-w this one, if it is yours alone"
            )

    def remove_counter(self, leaving: frozenset[str] = frozenset()) -> None:
        """Removes iceoryx2's counter of participants if no participant, dead or alive, is in the domain except for `leaving` (numbers of
        participants). If that is unknown, the counter stays. A participant that joins at this moment has its number already, and the next one
        begins a new counter."""

        def is_there(entry: pathlib.Path) -> bool:
            number = entry.name.removeprefix(self.prefix).partition(".")[0]
            return number not in leaving and (entry.name.startswith(self.prefix) or (entry / f"{self.prefix}node.details").exists())

        with contextlib.suppress(OSError):
            nodes = pathlib.Path(self.root) / "nodes"
            if not (nodes.exists() and any(map(is_there, nodes.iterdir()))):
                for file in self._shared_memory():
                    if file.name.endswith(_COUNTER_FILE):
                        file.unlink(missing_ok=True)

    def _shared_memory(self) -> list[pathlib.Path]:
        """The domain's files in shared memory."""
        return list(_SHARED_MEMORY.glob(f"{self.prefix}*"))

    def _refuse_foreign_shared_memory(self) -> None:
        """Any user may create files in /dev/shm. Another user's file with this domain's prefix could be read and written by that user."""
        for file in self._shared_memory():
            try:
                owner = file.lstat().st_uid
            except OSError:
                continue  # it is gone again
            if owner != os.geteuid():
                raise RoomcastError(
                    f"{file} belongs to user {owner}, who could read and write it: have it removed, or use another domain name"
                )

    def _close_to_others(self) -> None:
        """iceoryx2 opens one file per domain, its counter of participants, to every user. This restricts it to the owner."""
        for file in self._shared_memory():
            descriptor = _open_own(file, os.O_RDONLY)
            if descriptor is None:
                descriptor = _open_own(file, os.O_WRONLY)
            if descriptor is None:
                continue  # it is gone again, or not ours
            try:
                if os.fstat(descriptor).st_mode & 0o077:
                    os.fchmod(descriptor, 0o600)
            except OSError:
                continue  # the root still keeps others out
            finally:
                os.close(descriptor)


def _open_own(file: pathlib.Path, access: int) -> int | None:
    """Opens a file of the domain in shared memory, if it is a plain file of this user. Another user could have put a pipe there, which would
    block, or a link to another place."""
    try:
        descriptor = os.open(file, access | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NOCTTY)
    except OSError:
        return None
    try:
        about = os.fstat(descriptor)
        if stat.S_ISREG(about.st_mode) and about.st_uid == os.geteuid():
            return descriptor
    except OSError:
        pass
    os.close(descriptor)
    return None


def deadline_of(timeout_s: float | None) -> float:
    """The end of a wait that begins now; infinity without a limit. ValueError for NaN, because such a wait would never end."""
    if timeout_s is None:
        return math.inf
    if math.isnan(timeout_s):
        raise ValueError("timeout_s is nan; give seconds, or infinity to wait without a limit")
    return time.monotonic() + timeout_s


def refuse_full_shared_memory() -> None:
    """Raises an error in a case in which iceoryx2 would end by a signal."""
    try:
        about = os.statvfs(_SHARED_MEMORY)
    except OSError:
        return  # there is no such file system, and iceoryx2 says so
    free_bytes = about.f_bavail * about.f_frsize
    if free_bytes < _FREE_BYTES:
        raise RoomcastError(
            f"{_SHARED_MEMORY} has {free_bytes} bytes free, {_FREE_BYTES} are needed: remove what fills it, or mount it larger"
        )


class _Held:
    """Objects of iceoryx2 that belong to this process, and not to its forks.

    A forked process has copies. Using a copy would send in its parent's name, and deleting it would free its parent's place. So a copy refuses
    to be used, and is never deleted.
    """

    def __init__(self, what: str, *parts: Any) -> None:
        self._what = what
        self._parts = parts
        #: Whether this process was forked from the one that opened it.
        self.inherited = False
        _ALL_HELD.add(self)

    def refuse_inherited(self) -> None:
        """RoomcastError in a process that was forked after this was opened."""
        if self.inherited:
            raise RoomcastError(
                f"{self._what}: this was opened before this process was forked, and only the process that opened it may use it; "
                "open another after the fork"
            )

    def _inherit(self) -> None:
        self.inherited = True
        # An extra reference, never released, so that not even the end of Python deletes the object.
        for part in self._parts:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(part))


_ALL_HELD: weakref.WeakSet[_Held] = weakref.WeakSet()


def _inherit_all() -> None:
    for held in list(_ALL_HELD):
        held._inherit()


os.register_at_fork(after_in_child=_inherit_all)


class _LastOut:
    """Removes the counter of participants after the last one leaves, as in the Rust crate."""

    def __init__(self, domain: Domain) -> None:
        self._domain = domain

    def __del__(self) -> None:
        # At the end of Python, parts of this module may be gone.
        with contextlib.suppress(Exception):
            self._domain.remove_counter()


def _leave_all() -> None:
    """At the end of Python, participants leave in any order, before or after `_LastOut`."""
    nodes = [held for held in list(_ALL_HELD) if isinstance(held, Node) and not held.inherited]
    leaving = frozenset(str(node.inner.id.value) for node in nodes)
    for domain in {node.domain for node in nodes}:
        domain.remove_counter(leaving)


atexit.register(_leave_all)


class Node(_Held):
    """A participant's place in a domain."""

    def __init__(self, inner: Any, domain: Domain) -> None:
        self.inner = inner
        self.domain = domain
        # A tuple deletes its last part first: `inner` leaves before `_LastOut` counts the others.
        super().__init__(f"domain at {domain.root}", _LastOut(domain), inner)

    def retry(self, service: str, open_port: Callable[[], T]) -> T:
        """Opens a port of a service; retries while the failure may pass: a peer is starting, stopping, or has just died."""
        self.refuse_inherited()
        refuse_full_shared_memory()
        start = time.monotonic()
        while True:
            try:
                port = open_port()
            except Exception as error:  # iceoryx2's bindings have an exception type per operation
                if any(word in str(error) for word in _FINAL):
                    raise RoomcastError(
                        f"service {service}: {error!r}; a participant that started earlier set it up otherwise: all need the same version "
                        "of Roomcast and iceoryx2 0.10.0"
                    ) from error
                if time.monotonic() - start > _OPEN_FOR_S:
                    raise RoomcastError(
                        f"service {service}: cannot open it: {error!r}; tried for {_OPEN_FOR_S:.0f} s; where its places are taken, stop "
                        "another participant or use another domain"
                    ) from error
                self.inner.try_cleanup_dead_nodes()
                time.sleep(0.02)
                continue
            self.domain.commit_shared_memory()
            return port


def _publish_subscribe(node: Node, service: Service) -> Any:
    return (
        node.inner.service_builder(iox2.ServiceName.new(service.name))
        .publish_subscribe(service.payload)
        .max_publishers(service.publishers)
        .max_subscribers(service.subscribers)
        .max_nodes(_MAX_NODES)
        .subscriber_max_buffer_size(service.buffer)
        .subscriber_max_borrowed_samples(2)
        .history_size(service.history)
        .enable_safe_overflow(True)
        .open_or_create()
    )


def _event(node: Node, service: Service) -> Any:
    return (
        node.inner.service_builder(iox2.ServiceName.new(service.name))
        .event()
        .max_notifiers(service.publishers + _LEFT_BEHIND)
        .max_listeners(service.subscribers)
        .max_nodes(_MAX_NODES)
        .event_id_max_value(_EVENTS["dead"])
        .notifier_created_event(iox2.EventId.new(_EVENTS["created"]))
        .notifier_dropped_event(iox2.EventId.new(_EVENTS["dropped"]))
        .notifier_dead_event(iox2.EventId.new(_EVENTS["dead"]))
        .disable_deadline()
        .open_or_create()
    )


def _wake(node: Node, service: str) -> None:
    """Wakes the process that serves a service after a participant has joined or asked. That process sleeps on the events of another service; a
    notifier that is created and deleted there is an event. If waking fails, a newcomer waits for some hundred milliseconds."""
    if service == NARRATION.name:
        return
    with contextlib.suppress(Exception):  # iceoryx2's bindings have an exception type per operation
        _event(node, ROOM_SCORES if service == DECISION.name else NARRATION).notifier_builder().create().delete()


class Port(_Held):
    """A place at a service. Any thread may use or close it, and so may a signal's handler during its own thread's use.

    iceoryx2 ends the process if a deleted object is used, and does not delete an object in use. So the last user of a closed port deletes it.
    """

    def __init__(self, node: Node, service: str, *parts: Any) -> None:
        super().__init__(f"service {service}", *parts)
        self._service = service
        # Reentrant for signal handlers, and for nested uses.
        self._lock = threading.RLock()
        self._users = 0
        self._closed = False
        # Deleted after the parts: the node leaves with the last port.
        self._node = node

    @contextlib.contextmanager
    def use(self) -> Iterator[None]:
        """Keeps the port from being deleted inside. Fails like `refuse_unusable`."""
        # Before the lock, because in a forked process the lock may never be released.
        self.refuse_inherited()
        with self._lock:
            # Counted first: if a signal's handler closes the port from here on, this use deletes it.
            self._users += 1
        try:
            self.refuse_unusable()
            yield
        finally:
            with self._lock:
                self._users -= 1
                self._delete_unused()

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """As `use`, by one thread at a time."""
        self.refuse_inherited()
        with self._lock, self.use():
            yield

    def refuse_unusable(self) -> None:
        """ClosedError if it is closed, RoomcastError if it was opened before a fork."""
        self.refuse_inherited()
        if self._closed:
            raise ClosedError(f"service {self._service}: this place was closed, by `close` or by the end of a `with` block; make a new one")

    def close(self) -> None:
        """Frees the place, at once or when no thread uses it any more. Closing again does nothing, nor does closing a port from before a fork: the
        place is the parent's."""
        if self.inherited:
            return
        self._linger()
        with self._lock:
            self._closed = True
            self._delete_unused()

    def _linger(self) -> None:
        """Waits until it may be closed."""

    def _delete_unused(self) -> None:
        if self._closed and not self._users:
            for part in self._parts:
                part.delete()


class Publisher(Port):
    """Sends messages of one service, and never waits for a slow subscriber."""

    def __init__(self, node: Node, service: Service) -> None:
        def open_port() -> tuple[Any, Any]:
            # The publisher first, because its place is limited.
            publisher = _publish_subscribe(node, service).publisher_builder().create()
            data = iox2.EventId.new(_EVENTS["data"])
            return publisher, _event(node, service).notifier_builder().default_event_id(data).create()

        self._publisher, self._notifier = node.retry(service.name, open_port)
        self._sent_s = -math.inf
        super().__init__(node, service.name, self._publisher, self._notifier)

    def send(self, message: layouts.Message) -> int:
        """Sends a copy and wakes the subscribers. Returns the number of subscribers that received it. MessageError if the message is malformed."""
        message.check()
        return self.send_unchecked(message)

    def send_unchecked(self, message: layouts.Message) -> int:
        """As `send` without the check: for tests of what receivers do with malformed messages."""
        with self.alone():
            try:
                receivers: int = self._publisher.send_copy(message)
            except (iox2.LoanError, iox2.SendError) as error:
                raise RoomcastError(f"service {self._service}: send failed: {error!r}; leave the domain and join again") from error
            self._sent_s = time.monotonic()
            # If this fails, the message is in the buffer, and a waiting subscriber checks the buffer after its timeout.
            with contextlib.suppress(iox2.NotifierNotifyError):
                self._notifier.notify()
            return receivers

    def tick(self) -> None:
        """Sends the history to subscribers that joined since; to be called from time to time if nothing is sent."""
        with self.alone():
            self._publisher.update_connections()

    def _linger(self) -> None:
        """Messages in shared memory are lost with their publisher, so recent ones get a moment."""
        if not self._closed:
            time.sleep(max(0.0, self._sent_s + _LINGER_S - time.monotonic()))


class Subscriber(Port, Generic[T]):
    """Receives messages of one service, each copied out of shared memory and checked by `read`."""

    def __init__(self, node: Node, service: Service, read: Callable[[Any], T]) -> None:
        self._payload = service.payload
        self._listening = threading.Lock()
        self._read = read
        #: Messages that were malformed and dropped.
        self.malformed = 0

        def open_port() -> tuple[Any, Any]:
            # The listener is created first, so that no wake-up is lost between the two.
            listener = _event(node, service).listener_builder().create()
            return listener, _publish_subscribe(node, service).subscriber_builder().buffer_size(service.buffer).create()

        self._listener, self._subscriber = node.retry(service.name, open_port)
        super().__init__(node, service.name, self._subscriber, self._listener)
        _wake(node, service.name)

    def wait(self, timeout_s: float) -> None:
        """Sleeps until there is news or the timeout is over; at least a moment."""
        failure = None
        deadline = time.monotonic() + timeout_s
        with self.use():
            # A listener has one timeout for all threads, so one thread listens and the others wait for it.
            if not self._listening.acquire(timeout=max(_MOMENT_S, timeout_s)):
                return
            try:
                self._listener.timed_wait(iox2.Duration.from_secs_f64(max(_MOMENT_S, deadline - time.monotonic())))
            except iox2.ListenerWaitError as error:
                failure = error
            finally:
                self._listening.release()
        # A signal ends the sleep, and Python's handler follows: out here, so that its exception is not chained to another error.
        if failure is not None and "InterruptSignal" not in str(failure):
            raise RoomcastError(f"service {self._service}: wait failed: {failure!r}; leave the domain and join again") from failure

    def receive(self) -> T | None:
        """Takes the oldest valid message; malformed ones are dropped and counted."""
        with self.alone():
            while (sample := self._subscriber.receive()) is not None:
                # The sender can still write to the sample, so a copy is checked and read.
                copy = self._payload.from_buffer_copy(bytes(sample.payload().contents))
                sample.delete()
                try:
                    copy.refuse_ahead(time.clock_gettime_ns(time.CLOCK_BOOTTIME))
                    return self._read(copy)
                except layouts.MessageError:
                    self.malformed += 1
        return None

    def newest(self) -> T | None:
        """Takes all waiting messages and returns the newest valid one."""
        newest = None
        with self.alone():
            while (message := self.receive()) is not None:
                newest = message
        return newest


def _item_scores(node: Node) -> Any:
    return (
        node.inner.service_builder(iox2.ServiceName.new(ITEM_SCORES))
        .publish_subscribe(iox2.Slice[layouts.ItemScoreV1])
        .user_header(layouts.ItemScoresHeaderV1)
        .max_publishers(1)
        .max_subscribers(8)
        .max_nodes(_MAX_NODES)
        .subscriber_max_buffer_size(2)
        .subscriber_max_borrowed_samples(2)
        .history_size(1)
        .enable_safe_overflow(True)
        .open_or_create()
    )


class ItemScoresSubscriber(Port):
    """Receives item scores, a slice with a header; the daemon sends them while this subscriber exists. They wake no subscriber."""

    def __init__(self, node: Node) -> None:
        self._subscriber = node.retry(ITEM_SCORES, lambda: _item_scores(node).subscriber_builder().create())
        super().__init__(node, ITEM_SCORES, self._subscriber)
        _wake(node, ITEM_SCORES)

    def receive(self) -> tuple[layouts.ItemScoresHeaderV1, list[layouts.ItemScoreV1]] | None:
        """Takes a copy of the oldest message."""
        with self.alone():
            sample = self._subscriber.receive()
            if sample is None:
                return None
            header = layouts.ItemScoresHeaderV1.from_buffer_copy(bytes(sample.user_header().contents))
            # The bindings give a slice's length in bytes, and their view reaches beyond its end.
            items = layouts.ItemScoreV1 * sample.header.number_of_elements
            copy = items.from_buffer_copy(ctypes.string_at(sample.payload().as_ptr(), ctypes.sizeof(items)))
            sample.delete()
            return header, list(copy)


def _client_builder(node: Node, service: str, request: Any, response: Any) -> Any:
    return (
        node.inner.service_builder(iox2.ServiceName.new(service))
        .request_response(request, response)
        .max_servers(1)
        .max_clients(8)
        .max_nodes(_MAX_NODES)
        .max_active_requests_per_client(4)
        .max_response_buffer_size(2)
        .max_borrowed_responses_per_pending_response(2)
        .max_loaned_requests(2)
        .enable_fire_and_forget_requests(True)
        .enable_safe_overflow_for_requests(True)
        .enable_safe_overflow_for_responses(True)
        .open_or_create()
        .client_builder()
    )


def _answer(service: str, send: Callable[[], Any], read: Callable[[Any], T | None], again_s: float, deadline: float, timeout_s: float) -> T:
    """Sends a request and waits for the answer until the deadline. Sends it again from time to time, because a daemon that starts later never gets
    the first one. If `read` finds no answer, sends it again at once."""
    while time.monotonic() < deadline:
        pending = send()
        again = time.monotonic() + again_s
        while time.monotonic() < min(again, deadline):
            answer = pending.receive()
            if answer is not None:
                copy = read(answer)
                answer.delete()
                if copy is not None:
                    return copy
                break
            time.sleep(0.002)
    raise _no_answer(service, timeout_s)


def _no_answer(service: str, timeout_s: float) -> NoAnswerError:
    return NoAnswerError(f"service {service}: no answer within {timeout_s} s; is the daemon running in this domain?")


class _Client(Port):
    """A client of one service."""

    def __init__(self, node: Node, service: str, open_client: Callable[[], Any]) -> None:
        self._client = node.retry(service, open_client)
        self._asking = threading.Lock()
        super().__init__(node, service, self._client)

    def _ask(self, send: Callable[[], Any], read: Callable[[Any], T | None], again_s: float, timeout_s: float) -> T:
        def send_and_wake() -> Any:
            # If it was closed in the meantime, it asks no more.
            self.refuse_unusable()
            pending = send()
            _wake(self._node, self._service)
            return pending

        deadline = deadline_of(timeout_s)
        with self.use():
            # A client may have few pending requests, so one thread asks and the others wait for it.
            if not self._asking.acquire(timeout=min(max(0.0, deadline - time.monotonic()), threading.TIMEOUT_MAX)):
                raise _no_answer(self._service, timeout_s)
            try:
                return _answer(self._service, send_and_wake, read, again_s, deadline, timeout_s)
            finally:
                self._asking.release()


class StatusClient(_Client):
    """Asks the daemon for its status."""

    def __init__(self, node: Node) -> None:
        request, response = layouts.StatusRequestV1, layouts.StatusResponseV1
        super().__init__(node, STATUS, lambda: _client_builder(node, STATUS, request, response).create())

    def ask(self, timeout_s: float) -> layouts.StatusResponseV1:
        """Asks, and waits for a copy of the answer."""

        def read(answer: Any) -> layouts.StatusResponseV1:
            return layouts.StatusResponseV1.from_buffer_copy(bytes(answer.payload().contents))

        return self._ask(lambda: self._client.send_copy(layouts.StatusRequestV1()), read, 0.3, timeout_s)


class WordsClient(_Client):
    """Asks the daemon in JSON."""

    def __init__(self, node: Node, service: str) -> None:
        words = iox2.Slice[ctypes.c_uint8]
        growing = iox2.AllocationStrategy.PowerOfTwo

        def open_client() -> Any:
            return _client_builder(node, service, words, words).initial_max_slice_len(4096).allocation_strategy(growing).create()

        super().__init__(node, service, open_client)

    def ask(self, question: str, timeout_s: float = 10) -> str:
        """Asks, and waits for the answer."""
        data = question.encode()
        if len(data) > _QUESTION_BYTES_MAX:
            raise RoomcastError(f"service {self._service}: a question of {len(data)} bytes, at most {_QUESTION_BYTES_MAX} fit; split it")

        def send() -> Any:
            request = self._client.loan_slice_uninit(len(data))
            ctypes.memmove(request.payload().as_ptr(), data, len(data))
            return request.assume_init().send()

        def read(answer: Any) -> bytes | None:
            return _whole(self._node.domain, self._service, bytes(answer.payload().as_memory_view()))

        answer = self._ask(send, read, 0.5, timeout_s)
        try:
            return answer.decode()
        except UnicodeDecodeError as error:
            raise RoomcastError(
                f"service {self._service}: the answer is not UTF-8 from byte {error.start} on; is the daemon of this version?"
            ) from error


_QUESTION_BYTES_MAX = 1 << 20
# An answer too long for shared memory is in a file with a random name; this text replaces it.
_IN_FILE = re.compile(rb'\{"answer":"in-file","name":"([0-9a-fA-F]{16})"\}')


def _whole(domain: Domain, service: str, answer: bytes) -> bytes | None:
    """The answer, read from its file if it is in one; None if the file is gone: newer answers replaced it, or a person was forgotten."""
    in_file = _IN_FILE.fullmatch(answer)
    if in_file is None:
        return answer
    path = pathlib.Path(domain.root, f"{domain.prefix}{service.rsplit('/')[-1]}-{in_file[1].decode()}.answer")
    try:
        answer = path.read_bytes()
        # It may contain personal data.
        path.unlink(missing_ok=True)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RoomcastError(f"service {service}: the answer in {path} cannot be read: {error.strerror}; ask again") from error
    return answer
