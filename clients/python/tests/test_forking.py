"""What was open before a fork stays the parent's: the child is told, and whatever the child does takes nothing away."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import samples
from roomcast import Domain

FORKING = """
    def files():
        return sorted(map(str, [*pathlib.Path(domain.root).rglob("*"), *pathlib.Path("/dev/shm").glob(f"{domain.prefix}*")]))

    def fork(child):
        process = os.fork()
        if process == 0:
            child()
            sys.exit(0)
        assert os.waitpid(process, 0)[1] == 0, child.__name__

    def ends():
        pass

    def closes():
        each.close()

    def lets_go():
        global each
        del each
        gc.collect()

    def leaves_the_block():
        with each:
            pass

    def has_a_child():
        fork(uses_it)

    def opens_its_own():
        with Narrator("child", domain), Planner("child", domain), Robot("child", domain), Subscription(Decision, "child", domain):
            uses_it()

    def uses_it():
        for use in [*uses(), loop]:
            try:
                use()
            except RoomcastError as error:
                assert "opened before this process was forked" in str(error) and "open another after the fork" in str(error), error
                assert not isinstance(error, ClosedError), "it ends a loop as if all were well"
            else:
                raise AssertionError("the parent's place was used")

    def loop():
        endless = {Planner: "scores", Robot: "decisions", Narrator: "newest"}.get(type(each), "__iter__")
        next(getattr(each, endless)())

    for use in uses():
        use()
    before = files()
    for child in [ends, closes, lets_go, leaves_the_block, has_a_child, opens_its_own, uses_it]:
        fork(child)
        assert set(before) <= set(files()), (child.__name__, set(before) - set(files()))
    for use in uses():
        use()
    each.close()
    assert not set(before) <= set(files()), "the parent itself takes its places away"
"""


@pytest.fixture
def domain() -> Iterator[Domain]:
    with samples.private_domain() as domain:
        yield domain


@pytest.mark.parametrize("kind", samples.KINDS)
def test_a_fork_takes_nothing_away(kind: str, domain: Domain) -> None:
    ended = samples.of_a_kind(kind, FORKING, domain)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")


def test_a_child_says_nothing_in_its_parents_name(domain: Domain) -> None:
    """Two that said something of one number would be taken for one, and one of them would not be missed."""
    saying = """
        from roomcast import ports

        ears = ports.Subscriber(domain.open("daemon"), ports.NARRATION, lambda message: message.sequence)
        each.say("They sit.")
        if os.fork() == 0:
            with each:
                try:
                    each.say("They grab the milk.")
                except RoomcastError:
                    sys.exit(0)
        assert os.wait()[1] == 0
        each.say("They stand up.")
        heard = [ears.receive() for _ in range(3)]
        assert heard == [1, 2, None], heard
    """
    ended = samples.of_a_kind("narrator", saying, domain)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
