"""Closing ends a loop and harms nobody, whichever thread closes; and threads that share a participant disturb one another nowhere."""

from __future__ import annotations

import pathlib
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import samples
from roomcast import ClosedError, Domain, MessageError, Narrator, NotIncludedError, Planner, Robot, StatusSubscription, layouts, ports

# What yields without end.
LOOP = """
    def loop():
        if isinstance(each, Narrator):
            try:
                while True:
                    each.wait_until_included(1)
                    each.newest()
            except ClosedError:
                return
        for message in each.scores() if isinstance(each, Planner) else each.decisions() if isinstance(each, Robot) else each:
            print("no message was sent, but", message)

    def is_closed():
        loop()
        for number, use in enumerate(uses()):
            try:
                use()
                print("use", number, "of what is closed")
            except ClosedError as error:
                assert "make a new one" in str(error)
"""
CLOSING = {
    "twice": """
        each.close()
        each.close()
        is_closed()
    """,
    "with": """
        with each as same:
            assert same is each
        is_closed()
    """,
    "another thread": """
        threads = [threading.Thread(target=loop) for _ in range(2)]
        [thread.start() for thread in threads]
        time.sleep(0.3)
        each.close()
        [thread.join() for thread in threads]
        is_closed()
    """,
    "a signal's handler": """
        signal.signal(signal.SIGTERM, lambda *_: each.close())
        threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGTERM)).start()
        loop()
        is_closed()
    """,
}


@pytest.fixture
def domain() -> Iterator[Domain]:
    with samples.private_domain() as domain:
        yield domain


@pytest.mark.parametrize("kind", samples.KINDS)
@pytest.mark.parametrize("closing", CLOSING)
def test_what_is_closed_ends_loops_and_refuses_the_rest(closing: str, kind: str, domain: Domain) -> None:
    ended = samples.of_a_kind(kind, textwrap.dedent(LOOP) + textwrap.dedent(CLOSING[closing]), domain)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")


ENDING = {
    "without closing": "",
    "closed": "each.close()",
    "by an error": "raise ValueError",
}


@pytest.mark.parametrize("kind", samples.KINDS)
@pytest.mark.parametrize("ending", ENDING)
def test_the_last_participant_leaves_nothing_in_shared_memory(ending: str, kind: str, domain: Domain) -> None:
    samples.of_a_kind(kind, "uses()[0] if isinstance(each, Narrator) else None\n" + ENDING[ending], domain)
    assert list(pathlib.Path("/dev/shm").glob(f"{domain.prefix}*")) == []


def test_participants_that_stay_keep_the_domain_s_shared_memory(domain: Domain) -> None:
    with Planner("planner", domain):
        samples.of_a_kind("robot", "", domain)
        counters = list(pathlib.Path("/dev/shm").glob(f"{domain.prefix}*.global_mgmt"))
        assert len(counters) == 1


class Part:
    """In the place of a port of iceoryx2's, which may not be used after it was deleted, nor deleted while it is used."""

    def __init__(self) -> None:
        self.used = self.deleted = 0

    def delete(self) -> None:
        assert not self.used
        self.deleted += 1


def test_the_last_user_deletes_what_is_closed(domain: Domain) -> None:
    for use in (ports.Port.use, ports.Port.alone):
        part = Part()
        port = ports.Port(domain.open("x"), "some/service", part)
        with use(port):
            part.used += 1
            with use(port):
                port.close()
                assert not part.deleted
            with pytest.raises(ports.ClosedError, match="service some/service: this place was closed"), use(port):
                pytest.fail("it was closed")
            part.used -= 1
        assert part.deleted
        port.close()


def together(do: Callable[[int], object], threads: int = 3, times: int = 40) -> None:
    """Does it in several threads at once, which take turns as often as they can."""
    failed: list[BaseException] = []

    def work(thread: int) -> None:
        try:
            for _ in range(times):
                do(thread)
        except BaseException as error:
            failed.append(error)

    every, started = sys.getswitchinterval(), [threading.Thread(target=work, args=(number,)) for number in range(threads)]
    sys.setswitchinterval(1e-6)
    try:
        for each in started:
            each.start()
        for each in started:
            each.join()
    finally:
        sys.setswitchinterval(every)
    assert not failed, failed


def test_threads_that_share_a_participant_number_all_that_they_send(domain: Domain, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[int] = []
    send_unchecked = ports.Publisher.send_unchecked

    def send(publisher: ports.Publisher, message: Any) -> None:
        sent.append(message.sequence)
        send_unchecked(publisher, message)

    monkeypatch.setattr(ports.Publisher, "send_unchecked", send)
    with Planner("planner", domain) as planner:
        together(lambda thread: planner.pause("somebody comes") if thread else planner.decide("hall", "it is empty"))
    assert sent == list(range(1, 121)) and planner.sequence == 120
    sent.clear()
    with Robot("robot", domain) as robot:
        together(lambda thread: robot.started("hall") if thread else robot.docked())
    assert sent == list(range(1, 121)) and robot.sequence == 120


def test_threads_that_share_a_narrator_are_heard_once_and_in_order(domain: Domain) -> None:
    """More than may be under way, with one that hears them as they come."""
    heard: list[int] = []
    narrator, over = Narrator("py-narrator", domain), threading.Event()
    ears: ports.Subscriber[Any] = ports.Subscriber(domain.open("ears"), ports.NARRATION, lambda message: message)
    scores = ports.Publisher(domain.open("daemon"), ports.ROOM_SCORES)

    def hear() -> None:
        sequence = 0
        while not over.wait(0.005):
            while (message := ears.receive()) is not None:
                heard.append(message.sequence)
            sequence += 1
            said = samples.scores(sequence)
            said.included[0] = layouts.IncludedV1(
                source=narrator.source, epoch=narrator.epoch, sequence=max(heard, default=0), accepted=len(heard)
            )
            scores.send(said)

    daemon = threading.Thread(target=hear)
    daemon.start()
    try:
        together(lambda thread: narrator.say("They sit.") if thread else narrator.presence("away"))
        assert narrator.wait_until_included(float("inf")) is not None
    finally:
        over.set()
        daemon.join()
    assert heard == list(range(1, 121)) and (narrator.sequence, narrator.under_way, narrator.dropped) == (120, 0, 0)


def test_what_is_refused_takes_no_number_of_another_thread(domain: Domain) -> None:
    planner = Planner("planner", domain)

    def decide(thread: int) -> None:
        if thread:
            planner.decide("hall", "it is empty")
            return
        with pytest.raises(MessageError):
            planner.decide("a" * 49, "it is empty")

    together(decide)
    assert planner.sequence == 80


def test_threads_that_share_a_subscription_get_each_message_once(domain: Domain) -> None:
    publisher = ports.Publisher(domain.open("robot"), ports.ROBOT_REPORT)
    subscriber: ports.Subscriber[int] = ports.Subscriber(domain.open("watcher"), ports.ROBOT_REPORT, lambda message: message.sequence)
    for sequence in range(1, 61):
        publisher.send(samples.robot_report(sequence))
    told: list[int] = []

    def take(_: int) -> None:
        subscriber.wait(0)
        if (sequence := subscriber.receive()) is not None:
            told.append(sequence)

    together(take)
    assert sorted(told) == list(range(1, 61))


def test_threads_that_share_a_status_wait_for_one_another_and_for_the_daemon(domain: Domain) -> None:
    with StatusSubscription("asker", domain) as status:
        together(lambda _: status.next(0.1), threads=8, times=2)


def test_a_narrator_that_is_closed_inside_its_block_says_what_is_in_no_scores(domain: Domain) -> None:
    with Narrator("py-silent", domain) as narrator:
        narrator.close()
    with pytest.raises(NotIncludedError, match="1 of 1 narrations were in no scores when it was closed"):
        with Narrator("py-narrator", domain) as narrator:
            narrator.say("They sit.")
            narrator.close()
    with pytest.raises(ClosedError):
        narrator.wait_until_included(0)
