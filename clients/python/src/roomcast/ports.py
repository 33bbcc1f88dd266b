"""Nodes, publishers and subscribers with the settings of `roomcast-ipc`."""

from __future__ import annotations

import ctypes
import os
import time
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import iceoryx2 as iox2

from . import layouts

Payload = TypeVar("Payload", bound=ctypes.Structure)

_EVENTS = {"data": 1, "created": 2, "dropped": 3, "dead": 4}
_MAX_NODES = 32
# Places for notifiers of killed processes, as in the Rust crate.
_LEFT_BEHIND = 64


@dataclass(frozen=True)
class Service:
    """A service with its quality, all of which every participant states."""

    name: str
    payload: type[ctypes.Structure]
    publishers: int
    subscribers: int
    buffer: int
    history: int


NARRATION = Service("roomcast/v1/narration", layouts.NarrationV1, 8, 4, 256, 32)
ROOM_SCORES = Service("roomcast/v1/room-scores", layouts.RoomScoresV1, 1, 16, 2, 1)
FORECAST = Service("roomcast/v1/forecast", layouts.ForecastV1, 1, 16, 2, 1)
DECISION = Service("roomcast/v1/decision", layouts.DecisionV1, 8, 16, 16, 1)


class RoomcastError(Exception):
    """A service cannot be opened or used; the message says which, and what to do."""


@dataclass(frozen=True)
class Domain:
    """A private world of services: participants with the same root directory and name see one another, and nobody else."""

    root: str
    name: str = "roomcast"

    @staticmethod
    def default_for_user() -> Domain:
        """The domain of all commands when none is given: under XDG_RUNTIME_DIR, else /tmp/roomcast-UID."""
        base = os.environ.get("XDG_RUNTIME_DIR", "")
        root = os.path.join(base, "roomcast")
        if not os.path.isabs(root) or len(os.fsencode(root)) > 40:
            root = f"/tmp/roomcast-{os.geteuid()}"
        return Domain(root)

    def open(self, participant: str) -> Any:
        """Joins as a node; the root directory is made if it is missing."""
        os.makedirs(self.root, mode=0o700, exist_ok=True)
        if os.stat(self.root).st_uid != os.geteuid():
            raise RoomcastError(f"{self.root} belongs to another user; all participants run as one user")
        iox2.set_log_level(iox2.LogLevel.Fatal)
        config = iox2.config.default()
        config.global_cfg.root_path = iox2.Path.new(self.root)
        config.global_cfg.prefix = iox2.FileName.new(f"{self.name}_")
        # iceoryx2's names are ASCII; people's are not.
        shown = participant.encode("ascii", "replace").decode()
        node = iox2.NodeBuilder.new().name(iox2.NodeName.new(shown)).config(config)
        # Ctrl-C stays Python's.
        return node.signal_handling_mode(iox2.SignalHandlingMode.Disabled).create(iox2.ServiceType.Ipc)


def _open(node: Any, service: Service) -> tuple[Any, Any]:
    """The publish-subscribe service and its event service; retried, since a peer that starts or stops is in the way for moments."""
    deadline = time.monotonic() + 3
    while True:
        try:
            name = iox2.ServiceName.new(service.name)
            data = (
                node.service_builder(name)
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
            event = (
                node.service_builder(name)
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
            return data, event
        except Exception as error:  # iceoryx2's bindings have an exception type per operation
            if time.monotonic() > deadline:
                raise RoomcastError(
                    f"failed to open {service.name}: {error!r}; all participants need iceoryx2 0.10.0, the same user and "
                    "the same root directory"
                ) from error
            time.sleep(0.02)


class Publisher(Generic[Payload]):
    """Sends messages of one kind, and never waits for a slow subscriber."""

    def __init__(self, node: Any, service: Service) -> None:
        self._data, event = _open(node, service)
        try:
            self._publisher = self._data.publisher_builder().create()
        except Exception as error:
            raise RoomcastError(f"{service.name} has its {service.publishers} publishers already: {error!r}") from error
        self._notifier = event.notifier_builder().default_event_id(iox2.EventId.new(_EVENTS["data"])).create()

    def send(self, message: Payload) -> None:
        """Sends a copy and wakes the subscribers."""
        self._publisher.send_copy(message)
        self._notifier.notify()

    def tick(self) -> None:
        """Hands the history to subscribers that joined since; to be called now and then while nothing is sent."""
        self._publisher.update_connections()


class Subscriber(Generic[Payload]):
    """Receives messages of one kind, each copied out of shared memory."""

    def __init__(self, node: Any, service: Service) -> None:
        data, event = _open(node, service)
        self._payload = service.payload
        self._listener = event.listener_builder().create()
        try:
            self._subscriber = data.subscriber_builder().buffer_size(service.buffer).create()
        except Exception as error:
            raise RoomcastError(f"{service.name} has its {service.subscribers} subscribers already: {error!r}") from error

    def wait(self, timeout_s: float) -> None:
        """Sleeps until there is news or the time is over."""
        self._listener.timed_wait(iox2.Duration.from_secs_f64(timeout_s))

    def receive(self) -> Payload | None:
        """Takes the oldest message that waits."""
        sample = self._subscriber.receive()
        if sample is None:
            return None
        # The sender can still write to the sample, so that a copy is what is read.
        copy = self._payload.from_buffer_copy(bytes(sample.payload().contents))
        sample.delete()
        return copy  # type: ignore[return-value]


MAP_CHANGE = "roomcast/v1/map-change"
MOMENT = "roomcast/v1/moment"
_QUESTION_BYTES_MAX = 1 << 20
_ASK_AGAIN_S = 0.5


def _question_client(node: Any, service: str, deadline: float) -> Any:
    """A client of a service of questions; retried, since a daemon that starts or stops is in the way for moments."""
    words = iox2.Slice[ctypes.c_uint8]
    while True:
        try:
            opened = (
                node.service_builder(iox2.ServiceName.new(service))
                .request_response(words, words)
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
            )
            growing = iox2.AllocationStrategy.PowerOfTwo
            return opened.client_builder().initial_max_slice_len(4096).allocation_strategy(growing).create()
        except Exception as error:  # iceoryx2's bindings have an exception type per operation
            if time.monotonic() > deadline:
                raise RoomcastError(f"failed to open {service}: {error!r}; all participants need iceoryx2 0.10.0") from error
            time.sleep(0.02)


def ask(node: Any, service: str, question: str, timeout_s: float = 10) -> str:
    """Asks the daemon in words (JSON) and waits for the answer; asks again now and then while none comes."""
    data = question.encode()
    if len(data) > _QUESTION_BYTES_MAX:
        raise RoomcastError(f"{service}: a question of {len(data)} bytes, at most {_QUESTION_BYTES_MAX} fit; split it")
    deadline = time.monotonic() + timeout_s
    client = _question_client(node, service, deadline)
    while time.monotonic() < deadline:
        request = client.loan_slice_uninit(len(data))
        ctypes.memmove(request.payload().as_ptr(), data, len(data))
        pending = request.assume_init().send()
        again = time.monotonic() + _ASK_AGAIN_S
        while time.monotonic() < min(again, deadline):
            answer = pending.receive()
            if answer is not None:
                text = bytes(answer.payload().as_memory_view()).decode()
                answer.delete()
                return text
            time.sleep(0.002)
    raise RoomcastError(f"{service}: no answer within {timeout_s} s; is the daemon running in this domain?")
