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
from roomcast import Domain, ItemScoresSubscription, layouts, ports

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
    "planner.py": "go to attic (scores are ",
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


@pytest.mark.parametrize("example", SAYS)
def test_the_example_runs(example: str, stand_in: Domain) -> None:
    command = [sys.executable, "-c", IN_DOMAIN, stand_in.root, stand_in.name, str(EXAMPLES / example)]
    running = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    alarm = threading.Timer(20, running.kill)
    alarm.start()
    assert running.stdin and running.stdout
    running.stdin.write("They grab the mug.\n")
    running.stdin.flush()
    line = running.stdout.readline()
    # Ctrl-C is how most of them end, and no fault.
    os.kill(running.pid, signal.SIGINT)
    _, errors = running.communicate()
    alarm.cancel()
    assert SAYS[example] in line, errors
    assert example in ENDS or (running.returncode, errors) == (0, "")
