"""Narrator and planner in Python with a real daemon, in a private domain; and with one another."""

from __future__ import annotations

import json
import pathlib
import re
import subprocess
import time
from collections.abc import Callable, Iterator

import pytest

import roomcast
import samples
from roomcast import (
    Action,
    Decision,
    DecisionFlags,
    Domain,
    Forecast,
    ItemScores,
    ItemScoresSubscription,
    MessageError,
    Narrator,
    NoAnswerError,
    NotIncludedError,
    PersonForecasts,
    PersonScores,
    Planner,
    Presence,
    ReportKind,
    Robot,
    RobotReport,
    RoomcastError,
    RoomScores,
    Status,
    StatusSubscription,
    Subscription,
    change_map,
    layouts,
    moment,
    ports,
    source_of_name,
    status,
)
from samples import ROOMCAST


@pytest.fixture
def domain() -> Iterator[Domain]:
    with samples.private_domain() as domain:
        yield domain


def test_a_decision_arrives(domain: Domain) -> None:
    with Planner("py-planner", domain) as planner, Subscription(Decision, "watcher", domain) as decisions:
        planner.decide("kitchen", "nobody is there", stay_s=60)
        decision = decisions.next(timeout_s=1)
        assert decision is not None
        assert (decision.to_room, decision.reason) == ("kitchen", "nobody is there")
        assert (decision.robot, decision.sequence, decision.action) == (source_of_name("py-planner"), 1, 1)
        assert decision.robot_name == "py-planner"
        assert decision.stay_ns == 60_000_000_000
        planner.decide("hall", "a" * 1000)
        decision = decisions.next(timeout_s=1)
        assert decision is not None and (decision.from_room, decision.reason) == ("kitchen", "a" * 256)


def test_a_decision_pauses_and_names_what_it_cancels(domain: Domain) -> None:
    with Planner("py-planner", domain) as planner, Subscription(Decision, "watcher", domain) as decisions:
        told = []
        for decide in [
            lambda: planner.decide("kitchen", "nobody is there"),
            lambda: planner.pause("somebody comes in", cancels=planner.sequence),
            lambda: planner.decide("kitchen", "they have left"),
            lambda: planner.decide("kitchen", "nobody is there"),
        ]:
            decide()
            decision = decisions.next(timeout_s=1)
            assert decision is not None and decision.to_room == "kitchen"
            told.append((decision.action, decision.cancels))
        assert told == [(Action.GO, 0), (Action.PAUSE, 1), (Action.GO, 0), (Action.STAY, 0)]
        for cancels in [5, -1]:
            with pytest.raises(ValueError):
                planner.pause("somebody comes in", cancels=cancels)


def test_a_name_may_be_in_any_letters(domain: Domain) -> None:
    with Planner("Кухонный помощник нашей бабушки", domain) as planner:
        planner.decide("kitchen", "nobody is there")


def test_what_a_bridge_repeats_is_an_order_to_no_robot(domain: Domain) -> None:
    publisher = ports.Publisher(domain.open("bridge"), ports.DECISION)
    with Robot("robot", domain) as robot:
        for sequence, flags in [(1, DecisionFlags(0)), (2, DecisionFlags.ELSEWHERE), (3, DecisionFlags(0))]:
            publisher.send(layouts.DecisionV1(robot=robot.robot, epoch=1, sequence=sequence, action=Action.GO, flags=flags))
        told = [robot.next(timeout_s=5) for _ in range(2)]
    assert [decision.sequence for decision in told if decision is not None] == [1, 3]


def test_what_is_refused_leaves_no_gap(domain: Domain) -> None:
    with Planner("py-planner", domain) as planner, Subscription(Decision, "watcher", domain) as decisions:
        for room, reason, stay_s in [("a" * 49, "", 0.0), ("hall", "\ud800", 0.0), ("hall", "", -1.0), ("hall", "", float("nan"))]:
            with pytest.raises(ValueError):
                planner.decide(room, reason, stay_s)
        planner.decide("hall", "nobody is there")
        decision = decisions.next(timeout_s=1)
        assert decision is not None and decision.sequence == 1
    narrator = Narrator("py-narrator", domain)
    for text in ["", "   ", "...", "two\nlines", "a" * 1025, "left\u202eright"]:
        with pytest.raises(ValueError):
            narrator.say(text)
    assert narrator.sequence == 0
    for person in (-1, (1 << 32) - 1, 1 << 32, "", "...", "4294967295", True, 1.5, "-1", "\u0663", "me", " Who", "Nobody", "THEY"):
        with pytest.raises(ValueError, match="give a number from 0 to 4294967294, or a name"):
            Narrator("py-narrator", domain, person)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="give a number from 0 to 4294967294, or a name"):
            narrator.say("They sit.", person=person)  # type: ignore[arg-type]
    for name in ("a" * 49, "left\u202eright"):
        with pytest.raises(MessageError, match="person_name"):
            narrator.say("They sit.", person=name)
    for presence in ("home", "unknown", Presence.UNKNOWN):
        with pytest.raises(ValueError, match="give 'present', 'away', 'gone' or 'empty'"):
            narrator.presence(presence)
    for presence, room in (("away", "kitchen"), ("present", ""), ("empty", " ")):
        with pytest.raises(ValueError, match="give a room's name, with presence 'present' or 'empty' alone"):
            narrator.presence(presence, room)
    for kind, name, room, keys, fault in (
        ("radar", "a", "hall", {}, "give one of motion"),
        ("motion", " ", "hall", {}, "give a text of at most 128 bytes"),
        ("motion", "a" * 129, "hall", {}, "give a text of at most 128 bytes"),
        ("motion", "a", None, {}, "give the room that a sensor sees"),
        ("phone", "a", "hall", {}, "none for a phone"),
        ("bed", "a", "hall", {"beyond": "porch"}, "beyond for a door alone"),
        ("motion", "a", "hall", {"hold_s": float("nan")}, "hold_s nan: give a number from 0 to 86400"),
        ("motion", "a", "hall", {"only_on": True, "on": False}, "give on=True"),
    ):
        with pytest.raises(ValueError, match=fault):
            narrator.sensor(kind, name, room, **({"on": True} | keys))  # type: ignore[arg-type]
    for room, person in ((None, None), ("kitchen", "ada"), ("kitchen", 0)):
        with pytest.raises(ValueError, match="give a room, and no person"):
            narrator.presence("empty", room, person)
    assert narrator.sequence == 0
    with Robot("robot", domain) as robot:
        for level in (1.5, -0.1, float("nan")):
            with pytest.raises(MessageError, match="battery"):
                robot.battery(level)
        with pytest.raises(MessageError, match="position_m"):
            robot.position((0.0, float("inf"), 0.0))
        with pytest.raises(ValueError, match="give x, y and z"):
            robot.position((1.0, 2.0))  # type: ignore[arg-type]
        with pytest.raises(MessageError, match="room"):
            robot.started("a" * 49)
        assert robot.sequence == 0


def test_no_persons_names_are_those_of_the_daemon() -> None:
    for file in ["core/src/narration/person.rs", "ipc/src/who.rs"]:
        source = (pathlib.Path(__file__).parents[3] / file).read_text()
        words = re.search(r"const NO_NAMES: .*?;$", source, re.DOTALL | re.MULTILINE)
        found = re.sub(r"\\\n\s*", "", words[0]) if words else ""
        assert roomcast._NO_NAMES == {word for text in re.findall(r'"([^"]+)"', found) for word in text.split("|")}, file


class Includes:
    """Says as a daemon does what its scores contain."""

    def __init__(self, domain: Domain) -> None:
        self.publisher = ports.Publisher(domain.open("daemon"), ports.ROOM_SCORES)
        self.narration: ports.Subscriber[layouts.NarrationV1] = ports.Subscriber(domain.open("ears"), ports.NARRATION, lambda message: message)
        self.sent = 0

    def heard(self) -> list[int]:
        numbers = []
        while (message := self.narration.receive()) is not None:
            numbers.append(message.sequence)
        return numbers

    def include(self, narrator: Narrator, sequence: int, accepted: int, daemon: int = 3) -> None:
        self.sent += 1
        message = samples.scores(self.sent)
        message.epoch = daemon
        message.included[0] = layouts.IncludedV1(source=narrator.source, epoch=narrator.epoch, sequence=sequence, accepted=accepted)
        self.publisher.send(message)


def test_what_the_daemon_did_not_take_is_no_success(domain: Domain) -> None:
    narrator = Narrator("py-narrator", domain)
    daemon = Includes(domain)
    for _ in range(3):
        narrator.say("They sit.")
    daemon.include(narrator, 2, 2)
    assert narrator.wait_until_included(0.3) is None
    daemon.include(narrator, 3, 2)
    with pytest.raises(NotIncludedError, match="narrator 'py-narrator': the daemon has not taken 1 of 3 narrations: .*`malformed`"):
        narrator.wait_until_included(0.3)
    # It was only named later; a daemon that starts again counts in its own way.
    daemon.include(narrator, 3, 3)
    assert narrator.wait_until_included(0) is not None and narrator.dropped == 0
    narrator.say("They sit.")
    daemon.include(narrator, 4, 1, daemon=4)
    assert narrator.wait_until_included(5) is not None
    narrator.say("They sit.")
    daemon.include(narrator, 5, 1, daemon=4)
    with pytest.raises(NotIncludedError):
        narrator.wait_until_included(0.3)


def test_no_more_is_under_way_than_the_service_keeps(domain: Domain, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roomcast, "_PATIENCE_S", 0.3)
    narrator = Narrator("py-narrator", domain)
    for _ in range(32):
        narrator.say("They sit.")
    with pytest.raises(NotIncludedError, match="32 narrations wait for the daemon.*is the daemon running in this domain.*`malformed`"):
        narrator.say("They sit.")
    assert narrator.sequence == 32 and narrator.under_way == 32
    # A daemon that starts now gets all of them.
    daemon = Includes(domain)
    assert narrator.wait_until_included(0.3) is None
    assert daemon.heard() == list(range(1, 33))
    daemon.include(narrator, 10, 10)
    for _ in range(10):
        narrator.say("They sit.")
    assert narrator.under_way == 32 and daemon.heard() == list(range(33, 43))


def test_leaving_says_what_is_in_no_scores(domain: Domain, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roomcast, "_PATIENCE_S", 0.3)
    with pytest.raises(NotIncludedError, match="2 of 2 narrations were in no scores.*`malformed`"), Narrator("py-narrator", domain) as narrator:
        narrator.say("They sit.")
        narrator.say("They stand up.")
    # Whoever fails inside hears of that, and whoever has said nothing has lost nothing.
    with pytest.raises(KeyError), Narrator("another", domain) as narrator:
        narrator.say("They sit.")
        raise KeyError
    with Narrator("third", domain):
        pass


def test_a_narrator_says_of_whom(domain: Domain) -> None:
    heard: ports.Subscriber[layouts.NarrationV1] = ports.Subscriber(domain.open("daemon"), ports.NARRATION, lambda message: message)

    def told() -> tuple[int, str, int, str]:
        heard.wait(1)
        message = heard.receive()
        assert message is not None
        message.check()
        return message.person, layouts.read_text("name", message.person_name), message.kind, layouts.read_text("text", message.text)

    somebody = layouts.ALL_PERSONS
    narrator = Narrator("py-narrator", domain)
    narrator.say("They sit.")
    assert told() == (somebody, "", 0, "They sit.")
    narrator.say("They sit.", person=3)
    assert told() == (3, "", 0, "They sit.")
    with pytest.raises(ValueError, match="give a verb in brackets"):
        narrator.act("[Grab milk")
    narrator.act("[Grab] <mug> (1)", person=" Ada ")
    assert told() == (somebody, "Ada", 1, "[Grab] <mug> (1)")
    narrator.person = "Ben"
    narrator.device("the oven is on")
    assert told() == (somebody, "Ben", 2, "the oven is on")
    narrator.presence("away")
    assert told() == (somebody, "Ben", 3, "away")
    narrator.presence(Presence.PRESENT, room="living room", person="0")
    assert told() == (0, "", 3, "present in the living room")
    narrator.presence("empty", room="kitchen")
    assert told() == (somebody, "", 3, "nobody in the kitchen")
    narrator.sensor("motion", "hall-pir", "hall", on=True)
    assert told() == (somebody, "", 3, '{"sensor":"motion","id":"hall-pir","room":"hall","on":true}')
    narrator.sensor("bed", "bed-left", "Küche", on=None, person="ada", hold_s=4)
    assert told() == (somebody, "ada", 3, '{"sensor":"bed","id":"bed-left","room":"Küche","hold_s":4,"on":null}')
    narrator.sensor("door", "porch", "hall", on=False, beyond="porch")
    assert told() == (somebody, "", 3, '{"sensor":"door","id":"porch","room":"hall","beyond":"porch","on":false}')
    narrator.sensor("phone", "ada-phone", on=True, person=3)
    assert told() == (3, "", 3, '{"sensor":"phone","id":"ada-phone","on":true}')
    narrator.sensor("appliance", "kettle", "kitchen", on=True, only_on=True, false_alarms_per_day=2)
    assert json.loads(told()[3]) == {
        "sensor": "appliance", "id": "kettle", "room": "kitchen", "on": True, "only_on": True, "false_alarms_per_day": 2
    }


def test_a_robot_follows_its_decisions_and_reports(domain: Domain) -> None:
    with (
        Planner("robot", domain) as planner,
        Planner("another", domain) as another,
        Subscription(RobotReport, "watcher", domain) as reports,
        Robot("robot", domain) as robot,
    ):
        assert robot.next(timeout_s=0) is None
        another.decide("hall", "not for this robot")
        planner.decide("kitchen", "nobody is there")
        decision = robot.next(timeout_s=1)
        assert decision is not None and decision.to_room == "kitchen" and robot.decision is decision
        assert robot.next(timeout_s=0.1) is None
        robot.started()
        robot.position((1.0, 2.0, 0.0), room="hall")
        robot.finished(note="a" * 200)
        robot.failed("hall", note="the door is closed")
        robot.docked(battery=0.25)
        told = [report for _, report in zip(range(5), reports, strict=False)]
    answered = (decision.epoch, decision.sequence)
    assert [(report.sequence, report.kind, report.room) for report in told] == [
        (1, ReportKind.STARTED, "kitchen"),
        (2, ReportKind.POSITION, "hall"),
        (3, ReportKind.FINISHED, "kitchen"),
        (4, ReportKind.FAILED, "hall"),
        (5, ReportKind.DOCKED, ""),
    ]
    assert [(report.decision_epoch, report.decision_sequence) for report in told] == [answered, (0, 0), answered, (0, 0), (0, 0)]
    assert [report.battery for report in told] == [None, None, None, None, 0.25]
    assert (told[1].position_m, told[2].note) == ((1, 2, 0), "a" * 120)
    assert all(report.robot == source_of_name("robot") and report.robot_name == "robot" for report in told)


def test_every_kind_is_waited_for(domain: Domain) -> None:
    node = domain.open("daemon")
    for kind in (RoomScores, PersonScores, Forecast, PersonForecasts, Decision, RobotReport):
        with Subscription(kind, "watcher", domain) as subscription:
            assert subscription.next(timeout_s=0) is None
            publisher = ports.Publisher(node, kind.SERVICE)
            publisher.send(samples.GOOD[kind.SERVICE.payload]())
            told = subscription.next(timeout_s=1)
            assert isinstance(told, kind) and told.sequence == 1 and subscription.malformed == 0


def test_malformed_messages_are_dropped_and_counted(domain: Domain) -> None:
    publisher = ports.Publisher(domain.open("daemon"), ports.ROOM_SCORES)
    with Subscription(RoomScores, "watcher", domain) as scores, Planner("py-planner", domain) as planner:
        for sequence, change in enumerate([lambda m: None, lambda m: setattr(m, "label_mass", float("inf"))] * 2, 1):
            message = samples.scores(sequence)
            change(message)
            publisher.send_unchecked(message)
        # Two wait at most: the last good one, and the malformed one after it.
        told = scores.next(timeout_s=1)
        assert told is not None and told.sequence == 3 and scores.next(timeout_s=0.1) is None and scores.malformed == 1
        newest = planner.newest()
        assert newest is not None and newest.sequence == 3 and planner.malformed == 1
    with pytest.raises(ValueError, match="label_mass: inf, allowed is 0 or more, finite"):
        publisher.send(message)


def test_heartbeats_are_no_news(domain: Domain) -> None:
    publisher = ports.Publisher(domain.open("daemon"), ports.ROOM_SCORES)
    with Subscription(RoomScores, "watcher", domain) as scores:
        # A heartbeat may be the first that is seen of new scores.
        for sequence, flags, news in [(1, 0, True), (1, 1, False), (2, 1, True), (2, 1, False)]:
            message = samples.scores(sequence)
            message.flags = flags
            publisher.send(message)
            told = scores.next(timeout_s=0.1)
            assert (told is not None) == news, (sequence, flags)
        assert scores.malformed == 0


def test_the_next_is_waited_for(domain: Domain) -> None:
    node = domain.open("daemon")
    with Subscription(Forecast, "watcher", domain) as forecasts:
        assert forecasts.next(timeout_s=0) is None
        publisher = ports.Publisher(node, ports.FORECAST)
        started = time.monotonic()
        assert forecasts.next(timeout_s=0.3) is None and time.monotonic() - started >= 0.3
        for sequence in (1, 2):
            publisher.send(samples.forecast(sequence))
        assert [forecast.sequence for _, forecast in zip(range(2), forecasts, strict=False)] == [1, 2]


def test_however_short_a_wait_is_it_ends(domain: Domain) -> None:
    """iceoryx2 takes less than a microsecond for no limit."""
    subscriber: ports.Subscriber[Decision] = ports.Subscriber(domain.open("watcher"), ports.DECISION, Decision.from_message)
    for timeout_s in (1e-3, 1e-7, 0, -1):
        subscriber.wait(timeout_s)
    with Subscription(Decision, "another", domain) as decisions:
        assert decisions.next(timeout_s=1e-4) is None


def test_no_wait_is_without_end_because_its_length_is_no_number(domain: Domain) -> None:
    nan = float("nan")
    narrator = Narrator("py-narrator", domain)
    narrator.say("They sit.")
    with (
        Planner("py-planner", domain) as planner,
        Robot("robot", domain) as robot,
        Subscription(Decision, "watcher", domain) as decisions,
        ItemScoresSubscription("items", domain) as items,
        StatusSubscription("statuses", domain) as statuses,
    ):
        for wait in [
            lambda: narrator.wait_until_included(nan),
            lambda: next(planner.scores(timeout_s=nan)),
            *(lambda each=each: each.next(timeout_s=nan) for each in (robot, decisions, items, statuses)),
            lambda: status(domain, timeout_s=nan),
            lambda: moment(domain, timeout_s=nan),
        ]:
            with pytest.raises(ValueError, match="timeout_s is nan; give seconds"):
                wait()
    for every_s in (nan, -1.0):
        with pytest.raises(ValueError, match="every_s is .*; give seconds"):
            StatusSubscription("statuses", domain, every_s=every_s)


def test_a_status_is_waited_for_no_longer_than_asked(domain: Domain, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []

    def ask(_: ports.StatusClient, timeout_s: float) -> layouts.StatusResponseV1:
        asked.append(timeout_s)
        raise NoAnswerError

    monkeypatch.setattr(ports.StatusClient, "ask", ask)
    with StatusSubscription("watcher", domain) as statuses:
        for timeout_s in (0.0, 1e-3, 0.05):
            asked.clear()
            assert statuses.next(timeout_s) is None
            assert asked and max(asked) <= max(timeout_s, 0.01), timeout_s


def test_an_answer_may_be_waited_for_without_a_limit(domain: Domain, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "_answer", lambda *_: samples.status())
    assert status(domain, timeout_s=float("inf")).map == "flat"


def test_what_a_subscription_does_not_follow_is_refused_before_it_joins(domain: Domain) -> None:
    others: list[object] = [Status, ItemScores, layouts.DecisionV1, "Decision", None, []]
    for kind in others:
        with pytest.raises(TypeError, match="give one of RoomScores, .*; ItemScoresSubscription and StatusSubscription follow the rest"):
            Subscription(kind, "watcher", domain)  # type: ignore[arg-type]
    assert not list(pathlib.Path(domain.root).iterdir()), "it joined all the same"


def test_a_room_that_the_scores_do_not_have_is_no_place_to_go(domain: Domain) -> None:
    daemon = ports.Publisher(domain.open("daemon"), ports.ROOM_SCORES)
    takes: list[Callable[[Planner], object]] = [lambda planner: next(planner.scores()), Planner.newest]
    for take in takes:
        with Planner("py-planner", domain) as planner, Subscription(Decision, "watcher", domain) as decisions:
            planner.decide("hall", "no scores are known")
            daemon.send(samples.scores())
            assert take(planner) is not None
            for room in ("Kitchen", "hall", "kitchen "):
                with pytest.raises(ValueError, match=f"room '{room}': .* no such room; give one of kitchen, bathroom, attic"):
                    planner.decide(room, "it is empty")
            planner.decide("kitchen", "it is empty")
            planner.pause("somebody comes")
            told = [decision for _, decision in zip(range(3), decisions, strict=False)]
            assert [(each.sequence, each.to_room, each.probability) for each in told] == [
                (1, "hall", 0.0),
                (2, "kitchen", 0.75),
                (3, "kitchen", 0.75),
            ]


def test_a_place_is_free_after_leaving(domain: Domain) -> None:
    kept: list[object] = []
    for _ in range(3):
        watchers = [Subscription(Decision, f"watcher-{number}", domain) for number in range(16)]
        for each in watchers:
            with each:
                kept.append(each)
    for kind in (Narrator, Planner, Robot):
        for number in range(17):
            with kind(f"{kind.__name__}-{number}", domain) as participant:
                kept.append(participant)


def test_a_name_that_is_long_is_cut_and_one_that_is_no_text_is_refused(domain: Domain) -> None:
    heard: ports.Subscriber[layouts.NarrationV1] = ports.Subscriber(domain.open("daemon"), ports.NARRATION, lambda message: message)
    narrator = Narrator("the camera above the door of the kitchen of our grandmother", domain)
    narrator.say("They sit.")
    message = heard.receive()
    assert message is not None and layouts.read_text("name", message.source_name) == narrator.name[:48]
    assert message.source == source_of_name(narrator.name)
    for kind in (Narrator, Planner, Robot):
        with pytest.raises(MessageError, match="name: half a character"):
            kind("half \ud800", domain)


def test_who_has_said_nothing_waits_for_nothing(domain: Domain) -> None:
    narrator = Narrator("py-narrator", domain)
    assert narrator.wait_until_included(float("inf")) is None
    daemon = Includes(domain)
    daemon.include(narrator, 0, 0)
    scores = narrator.wait_until_included(float("inf"))
    assert scores is not None and scores.sequence == 1


def test_nobody_answers_without_a_daemon(domain: Domain) -> None:
    with pytest.raises(RoomcastError, match="service roomcast/v1/status: no answer within 0.1 s; is the daemon running"):
        status(domain, timeout_s=0.1)
    with StatusSubscription("watcher", domain) as statuses:
        assert statuses.next(timeout_s=0.1) is None
    with pytest.raises(RoomcastError, match="service roomcast/v1/moment: no answer"):
        moment(domain, timeout_s=0.1)


@pytest.fixture
def daemon(domain: Domain) -> Iterator[Domain]:
    if not ROOMCAST or subprocess.run([ROOMCAST, "daemon", "--help"], capture_output=True, check=False).returncode:
        pytest.skip("SKIPPED: set ROOMCAST to the built binary")
    process = subprocess.Popen([ROOMCAST, "daemon", "--root", domain.root, "--domain", domain.name])
    yield domain
    process.terminate()
    assert process.wait(10) is not None


def test_a_narrator_is_heard_and_a_planner_sees_the_same_scores(daemon: Domain) -> None:
    with Planner("py-planner", daemon) as planner, Narrator("py-narrator", daemon) as narrator:
        narrator.say("They walk to the kitchen.")
        narrator.act("[Open] <fridge> (1)")
        heard = narrator.wait_until_included(20)
        assert heard is not None and heard.included[0].sequence == 2
        seen = [scores for scores in planner.scores(timeout_s=1)][-1]
        assert (seen.epoch, seen.sequence, seen.rooms) == (heard.epoch, heard.sequence, heard.rooms)
        assert sum(room.probability for room in seen.rooms) == pytest.approx(1)
        assert not [room for room in seen.rooms if not room.id]


def test_the_map_is_changed_and_the_moment_told(daemon: Domain) -> None:
    with Narrator("py-narrator", daemon) as narrator:
        narrator.say("They open the fridge.")
        before = narrator.wait_until_included(20)
        assert before is not None
        box = {"min_m": [0.2, 0.2, 0.0], "max_m": [0.8, 0.8, 1.6]}
        move = {"change": "move-item", "id": "fridge-1", "position_m": [0.5, 0.5, 0.5], "box": box}
        answer = change_map([move], daemon)
        assert (answer["new_labels"], answer["epoch"]) == (0, f"{before.epoch:016x}")
        with pytest.raises(RoomcastError, match="there is no item"):
            change_map([{"change": "remove-item", "id": "piano-1"}], daemon)
        narrator.say("They close the fridge.")
        after = narrator.wait_until_included(20)
        assert after is not None and after.map == answer["map"] != before.map
    told = moment(daemon)
    assert [read["text"] for read in told["narration"]] == ["They open the fridge.", "They close the fridge."]
    assert told["map_fingerprint"] == after.map
    for label in told["labels"]:
        tokens = sum(token["log_prob_nats"] for token in label["tokens"])
        assert tokens + label["prior_nats"] == pytest.approx(label["log_prob_nats"])


def test_an_answer_that_is_too_long_for_shared_memory_is_read_from_its_own_file(domain: Domain) -> None:
    def whole(name: str) -> bytes | None:
        return ports._whole(domain, ports.MOMENT, f'{{"answer":"in-file","name":"{name}"}}'.encode())

    def path(name: str) -> pathlib.Path:
        return pathlib.Path(domain.root, f"{domain.prefix}moment-{name}.answer")

    own, other = "0123456789abcdef", "fedcba9876543210"
    path(own).write_text("own")
    path(other).write_text("other")
    assert whole(own) == b"own" and not path(own).exists(), "it may tell of persons"
    assert path(other).read_text() == "other", "somebody else's"
    assert whole(own) is None, "it is asked again"
    path(own).mkdir()
    with pytest.raises(RoomcastError, match="service roomcast/v1/moment: the answer in .* cannot be read: Is a directory; ask again"):
        whole(own)
    assert whole("../../etc/passwd") == b'{"answer":"in-file","name":"../../etc/passwd"}', "no name leads elsewhere"


def test_an_answer_whose_file_is_gone_is_asked_for_until_the_time_is_over() -> None:
    class Told:
        def receive(self) -> Told:
            return self

        def delete(self) -> None:
            pass

    asked: list[int] = []

    def send() -> Told:
        asked.append(len(asked))
        return Told()

    assert ports._answer(ports.MOMENT, send, lambda _: len(asked) if len(asked) == 50 else None, 0.5, time.monotonic() + 60, 60) == 50


def test_an_answer_that_is_not_given_says_why(domain: Domain, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "_answer", lambda *_: b'{"answer":"none","reason":"the disk is full"}')
    with pytest.raises(RoomcastError, match="service roomcast/v1/moment: the disk is full"):
        moment(domain)


def test_a_long_moment_is_told(daemon: Domain) -> None:
    with Narrator("py-narrator", daemon) as narrator:
        narrator.say("They open the fridge.")
        assert narrator.wait_until_included(20)
    kept = next(item for item in moment(daemon)["scene"]["items"] if item["id"] == "fridge-1")
    added = [{"change": "add-item", "item": {**kept, "id": f"fridge-{number}"}} for number in range(100, 700)]
    assert change_map(added, daemon)["new_labels"] == 0
    told = moment(daemon)
    assert len(json.dumps(told, separators=(",", ":"))) > 1 << 16
    assert {f"fridge-{number}" for number in range(100, 700)} <= {item["id"] for item in told["scene"]["items"]}


def test_every_kind_can_be_followed(daemon: Domain) -> None:
    with (
        Narrator("py-narrator", daemon) as narrator,
        Subscription(RoomScores, "scores", daemon) as scores,
        Subscription(Forecast, "forecasts", daemon) as forecasts,
        ItemScoresSubscription("items", daemon) as items,
        StatusSubscription("statuses", daemon, every_s=0.1) as statuses,
    ):
        narrator.say("They walk to the kitchen.")
        heard = narrator.wait_until_included(20)
        assert heard is not None
        told = [each for each in (scores.next(10), scores.next(0.3)) if each is not None][-1]
        assert (told.sequence, told.rooms, told.window) == (heard.sequence, heard.rooms, 1)
        forecast = forecasts.next(10)
        assert forecast is not None and [room.id for room in forecast.rooms] == [room.id for room in told.rooms]
        item_scores = items.next(10)
        assert item_scores is not None and item_scores.epoch == told.epoch and item_scores.items[0].id
        first, second = statuses.next(10), statuses.next(10)
        assert first is not None and second is not None and second.answered_ns > first.answered_ns
        assert (second.accepted, second.malformed, second.map_fingerprint) == (1, 0, told.map)
