"""Every example runs, with a daemon of a few messages in its place."""

from __future__ import annotations

import os
import pathlib
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import iceoryx2 as iox2
import pytest

import samples
from roomcast import Action, DecisionFlags, Domain, ItemScoresSubscription, ReportKind, RobotReport, Subscription, layouts, ports

EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"
# Runs a file in a domain that is not the user's default one. What runs in the background of a shell has Ctrl-C ignored, and passes that on.
IN_DOMAIN = """
import runpy, signal, sys
import roomcast
signal.signal(signal.SIGINT, signal.default_int_handler)
domain = roomcast.Domain(*sys.argv[1:3])
roomcast.Domain.default_for_user = staticmethod(lambda: domain)
runpy.run_path(sys.argv[3])
"""


def item_scores() -> tuple[layouts.ItemScoresHeaderV1, list[layouts.ItemScoreV1]]:
    items = []
    for name, nats in {"mug-1": -2.5, "sofa-1": -7.0}.items():
        item = layouts.ItemScoreV1(log_score_nats=nats, partition=layouts.NO_PARTITION, label_items=1)
        layouts.write_text("id", item.id, name)
        layouts.write_text("label", item.label, name[:-2])
        items.append(item)
    return layouts.ItemScoresHeaderV1(epoch=3, sequence=1), items


class StandIn:
    """Publishes good messages of every kind, includes every narration, and answers for its status, until it is stopped."""

    def __init__(self, domain: Domain) -> None:
        self.node = domain.open("stand-in")
        self.publishers = {
            kind: ports.Publisher(self.node, service)
            for kind, service in {
                "scores": ports.ROOM_SCORES,
                "persons": ports.PERSON_SCORES,
                "forecast": ports.FORECAST,
                "person forecasts": ports.PERSON_FORECASTS,
                "decision": ports.DECISION,
                "report": ports.ROBOT_REPORT,
            }.items()
        }
        self.narrations: ports.Subscriber[Any] = ports.Subscriber(self.node, ports.NARRATION, lambda message: message)
        self.items = ports._item_scores(self.node).publisher_builder().initial_max_slice_len(8).create()
        self.server = self.status_service().server_builder().create()
        self.over = threading.Event()

    def status_service(self) -> Any:
        return (
            self.node.inner.service_builder(iox2.ServiceName.new(ports.STATUS))
            .request_response(layouts.StatusRequestV1, layouts.StatusResponseV1)
            .max_servers(1)
            .max_clients(8)
            .max_nodes(32)
            .max_active_requests_per_client(4)
            .max_response_buffer_size(2)
            .max_borrowed_responses_per_pending_response(2)
            .max_loaned_requests(2)
            .enable_fire_and_forget_requests(True)
            .enable_safe_overflow_for_requests(True)
            .enable_safe_overflow_for_responses(True)
            .open_or_create()
        )

    def run(self) -> None:
        sequence = 0
        scores = samples.scores()
        while not self.over.wait(0.05):
            sequence += 1
            scores.sequence = sequence
            while (heard := self.narrations.receive()) is not None:
                scores.included[0] = layouts.IncludedV1(source=heard.source, epoch=heard.epoch, sequence=heard.sequence, accepted=heard.sequence)
            self.publishers["scores"].send(scores)
            self.publishers["persons"].send(samples.person_scores(sequence))
            self.publishers["forecast"].send(samples.forecast(sequence))
            self.publishers["person forecasts"].send(samples.person_forecasts(sequence))
            self.publishers["decision"].send(samples.decision(sequence))
            self.publishers["report"].send(samples.robot_report(sequence))
            header, items = item_scores()
            sample = self.items.loan_slice_uninit(len(items))
            for index, item in enumerate(items):
                sample.payload()[index] = item
            sample.user_header().contents.epoch, sample.user_header().contents.sequence = header.epoch, sequence
            sample.assume_init().send()
            while (request := self.server.receive()) is not None:
                request.send_copy(samples.status())


@pytest.fixture
def stand_in() -> Iterator[Domain]:
    with samples.private_domain() as domain:
        daemon = StandIn(domain)
        thread = threading.Thread(target=daemon.run)
        thread.start()
        yield domain
        daemon.over.set()
        thread.join()


SAYS = {
    "decisions.py": "robot af0d9146555c6adf goes to bathroom: the person is least likely to go there next",
    "forecast.py": "in 10 s: kitchen is occupied with 75%",
    "items.py": "mug-1 (mug) at -2.50 nats",
    "narrator.py": "{'kitchen': 0.75, 'bathroom': 0.25, 'attic': 0.0}",
    "person_forecasts.py": "Ada in 0 s: kitchen",
    "persons.py": "0 is present: kitchen next",
    "planner.py": "go to kitchen (the forecast is ",
    "presence.py": "the daemon knows",
    "reports.py": "robot: finished bathroom the carpet too",
    "robot.py": "bathroom is done",
    "scores.py": "kitchen 75%, bathroom 25%, attic 0%",
    "status.py": "flat: 4 narrations, 1 malformed, 0 steps",
}


# What ends by itself.
ENDS = {"presence.py"}


def test_item_scores_are_as_many_as_were_sent(stand_in: Domain) -> None:
    with ItemScoresSubscription("watcher", stand_in) as subscription:
        scores = subscription.next(timeout_s=5)
    assert scores is not None and [(item.id, item.label, item.room) for item in scores.items] == [
        ("mug-1", "mug", None),
        ("sofa-1", "sofa", None),
    ]


def test_every_example_is_run() -> None:
    assert sorted(SAYS) == sorted(path.name for path in EXAMPLES.glob("*.py"))


class Running:
    """An example in a domain, which is ended by Ctrl-C: how most of them end, and no fault."""

    def __init__(self, example: str, domain: Domain) -> None:
        command = [sys.executable, "-c", IN_DOMAIN, domain.root, domain.name, str(EXAMPLES / example)]
        self.ends = example in ENDS
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.alarm = threading.Timer(20, self.process.kill)

    def __enter__(self) -> Running:
        self.alarm.start()
        return self

    def tell(self, line: str) -> None:
        assert self.process.stdin
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def line(self) -> str:
        assert self.process.stdout
        return self.process.stdout.readline()

    def __exit__(self, *_: object) -> None:
        os.kill(self.process.pid, signal.SIGINT)
        errors = self.process.communicate()[1]
        self.alarm.cancel()
        assert self.ends or (self.process.returncode, errors) == (0, "")


@pytest.mark.parametrize("example", SAYS)
def test_the_example_runs(example: str, stand_in: Domain) -> None:
    with Running(example, stand_in) as running:
        running.tell("They grab the mug.")
        assert SAYS[example] in running.line()


def test_the_narrator_goes_on_after_a_line_that_says_nothing(stand_in: Domain) -> None:
    with Running("narrator.py", stand_in) as running:
        for line in ["", "  ", "...", "They grab the mug."]:
            running.tell(line)
        assert [running.line().split(":")[0] for _ in range(3)] == ["not said"] * 3
        assert SAYS["narrator.py"] in running.line()


def decision(sequence: int, action: Action, room: str, flags: DecisionFlags = DecisionFlags(0)) -> layouts.DecisionV1:
    message = samples.decision(sequence)
    message.action, message.flags = action, flags
    layouts.write_text("to", message.to, room)
    return message


@pytest.fixture
def domain() -> Iterator[Domain]:
    with samples.private_domain() as domain:
        yield domain


@pytest.fixture
def planner(domain: Domain) -> Iterator[ports.Publisher]:
    """Decides nothing by itself, and hands its newest decision to whoever joins."""
    publisher, over = ports.Publisher(domain.open("planner"), ports.DECISION), threading.Event()

    def tick() -> None:
        while not over.wait(0.02):
            publisher.tick()

    thread = threading.Thread(target=tick)
    thread.start()
    yield publisher
    over.set()
    thread.join()


def test_every_action_is_told_as_what_it_is(domain: Domain, planner: ports.Publisher) -> None:
    told = []
    with Running("decisions.py", domain) as running:
        for sequence, (action, room) in enumerate([(Action.GO, "hall"), (Action.STAY, "hall"), (Action.STAY, ""), (Action.PAUSE, "hall")], 1):
            planner.send(decision(sequence, action, room))
            told.append(running.line().split(" ", 2)[2].split(":")[0])
    assert told == ["goes to hall", "waits in hall", "waits in whichever room it is in", "pauses in hall"]


def test_the_robot_does_not_begin_again_what_it_only_owes_a_report_of(domain: Domain, planner: ports.Publisher) -> None:
    with Subscription(RobotReport, "watcher", domain) as reports, Running("robot.py", domain):

        def answers(message: layouts.DecisionV1, count: int) -> list[tuple[int, ReportKind, str]]:
            planner.send(message)
            told = [reports.next(timeout_s=20) for _ in range(count)]
            return [(report.decision_sequence, report.kind, report.room) for report in told if report is not None]

        begun = answers(decision(1, Action.GO, "hall"), 2)
        assert begun == [(1, ReportKind.STARTED, "hall"), (1, ReportKind.FINISHED, "hall")]
        assert answers(decision(2, Action.GO, "hall", DecisionFlags.OWED), 1) == [(2, ReportKind.FINISHED, "hall")]
        assert answers(decision(3, Action.GO, "attic", DecisionFlags.OWED), 1) == [(3, ReportKind.FAILED, "attic")]
        assert answers(decision(4, Action.GO, "attic"), 2) == [(4, ReportKind.STARTED, "attic"), (4, ReportKind.FINISHED, "attic")]
