"""Control of a run: one screen acts, the others look on, and the run's chain records who had it when."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import astuple, dataclass
from pathlib import Path

import pytest

from service.core.records.run_events import ControlTaken
from service.people.control import Control
from service.people.person import AccountError, ControlError, NotAllowedError, Person
from service.people.sessions import People
from service.store.records import UnknownRunError
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import QUICK_HASHES, password_of, populate
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import start_run


@dataclass
class Room:
    """A run, and people on screens around it."""

    store: Store
    people: People
    control: Control
    clock: SteppedClock
    run: str
    data: Path

    def screen(self, account: str) -> Person:
        token = self.people.sign_in(account, password_of(account))
        person = self.people.person(token, idle_lock_s=1e9, deliberate=False)
        assert person is not None
        return person

    def holder(self) -> str:
        return self.control.holder(self.run).screen

    def record(self) -> list[tuple[str, str, str, str]]:
        """Changes of control as (who, screen, from whom, how)."""
        events = [(event.actor, event.payload) for event in self.store.events(self.run)]
        return [(who, p.screen, p.previous, p.how) for who, p in events if isinstance(p, ControlTaken)]


@pytest.fixture
def room(tmp_path: Path) -> Generator[Room]:
    clock = SteppedClock()
    with Store.open(tmp_path / "data", clock) as store:
        people = People(store, QUICK_HASHES)
        populate(people)
        yield Room(store, people, Control(store), clock, start_run(store), tmp_path / "data")


def test_nobody_has_control_until_somebody_takes_it(room: Room) -> None:
    grace, emmy = room.screen("grace"), room.screen("emmy")
    nobody = room.control.holder(room.run)
    assert astuple(nobody) == ("", "", "", False, "", "", "", 0.0, "", 0.0)
    with pytest.raises(ControlError, match="no screen"):
        room.control.require(room.run, grace)
    room.control.take(room.run, grace)
    room.control.take(room.run, grace)  # again: nothing changes
    room.control.require(room.run, grace)
    with pytest.raises(ControlError, match="Grace Hopper"):
        room.control.require(room.run, emmy)
    with pytest.raises(ControlError, match="Grace Hopper"):
        room.control.take(room.run, emmy)
    assert room.record() == [("grace", grace.screen, "", "free")]
    assert verify(room.data, room.run).ok


def test_asked_for_and_handed_over(room: Room) -> None:
    grace, emmy = room.screen("grace"), room.screen("emmy")
    room.control.take(room.run, grace)
    room.control.ask(room.run, emmy)
    assert room.control.holder(room.run).asked_by_account == "emmy"
    room.control.answer(room.run, grace, grant=False)
    assert room.control.holder(room.run).asked_by_screen == ""
    assert room.holder() == grace.screen
    room.control.ask(room.run, emmy)
    room.control.answer(room.run, grace, grant=True)
    assert room.holder() == emmy.screen
    assert room.record()[1:] == [("emmy", emmy.screen, "grace", "handed_over")]
    with pytest.raises(ControlError):
        room.control.answer(room.run, grace, grant=True)


def test_a_swapped_tablet_takes_its_persons_control_along(room: Room) -> None:
    old, new = room.screen("grace"), room.screen("grace")
    room.control.take(room.run, old)
    room.control.take(room.run, new)
    assert room.record()[-1] == ("grace", new.screen, "grace", "handed_over")
    with pytest.raises(ControlError):
        room.control.require(room.run, old)


@pytest.mark.parametrize("how", ["signed out", "expired", "disabled"])
def test_control_is_free_once_its_screen_is_gone(room: Room, how: str) -> None:
    grace = room.screen("grace")
    room.control.take(room.run, grace)
    if how == "signed out":
        room.people.sign_out(grace)
    elif how == "expired":
        room.clock.passed_s += 12 * 3600
    else:
        room.people.accounts.disable(room.screen("ada"), "grace", "left the house")
    assert room.holder() == ""
    emmy = room.screen("emmy")
    room.control.take(room.run, emmy)
    assert room.holder() == emmy.screen


def test_a_supervisor_takes_over_with_a_reason(room: Room) -> None:
    grace, emmy = room.screen("grace"), room.screen("emmy")
    room.control.take(room.run, grace)
    with pytest.raises(AccountError, match="reason"):
        room.control.take_over(room.run, emmy, " ")
    room.control.take_over(room.run, emmy, "Grace was called away")
    assert room.record()[-1] == ("emmy", emmy.screen, "grace", "taken_over")
    with pytest.raises(NotAllowedError):
        room.control.take_over(room.run, grace, "I want it back")


def test_a_locked_screen_that_does_not_answer_loses_control(room: Room) -> None:
    grace, emmy = room.screen("grace"), room.screen("emmy")
    room.control.take(room.run, grace)
    room.control.ask(room.run, emmy)
    room.clock.passed_s += 61
    with pytest.raises(ControlError):  # somebody is there: the screen is open
        room.control.take(room.run, emmy)
    room.people.lock(grace)
    room.control.take(room.run, emmy)
    assert room.record()[-1] == ("emmy", emmy.screen, "grace", "taken_over")


def test_a_request_from_before_the_clock_was_set_back_blocks_nobody_and_its_wait_begins_anew(room: Room) -> None:
    grace, emmy = room.screen("grace"), room.screen("emmy")
    room.control.take(room.run, grace)
    room.people.lock(grace)
    room.control.ask(room.run, emmy)
    room.clock.set_utc(-3600.0)
    with pytest.raises(ControlError):  # nobody knows how long she has waited
        room.control.take(room.run, emmy)
    room.control.ask(room.run, emmy)
    room.clock.passed_s += 61
    room.control.take(room.run, emmy)
    assert room.holder() == emmy.screen


def test_another_person_may_ask_once_the_clock_was_set_back(room: Room) -> None:
    grace, emmy, other = room.screen("grace"), room.screen("emmy"), room.screen("emmy")
    room.control.take(room.run, grace)
    room.control.ask(room.run, emmy)
    with pytest.raises(ControlError):
        room.control.ask(room.run, other)
    room.clock.set_utc(-3600.0)
    room.control.ask(room.run, other)
    assert room.control.holder(room.run).asked_by_screen == other.screen


def test_a_clock_that_is_set_forward_shortens_no_wait_for_the_answer(room: Room) -> None:
    grace, emmy = room.screen("grace"), room.screen("emmy")
    room.control.take(room.run, grace)
    room.people.lock(grace)
    room.control.ask(room.run, emmy)
    room.clock.set_utc(3600.0)
    with pytest.raises(ControlError):
        room.control.take(room.run, emmy)
    room.clock.passed_s += 60
    room.control.take(room.run, emmy)
    assert room.holder() == emmy.screen


def test_asking_too_soon_does_not_take_it(room: Room) -> None:
    grace, emmy = room.screen("grace"), room.screen("emmy")
    room.control.take(room.run, grace)
    room.people.lock(grace)
    with pytest.raises(ControlError):
        room.control.take(room.run, emmy)
    room.control.ask(room.run, emmy)
    room.clock.passed_s += 30
    room.control.ask(room.run, emmy)  # asking again does not restart the waiting time
    with pytest.raises(ControlError):
        room.control.take(room.run, emmy)
    room.clock.passed_s += 30
    room.control.take(room.run, emmy)


def test_given_back(room: Room) -> None:
    grace = room.screen("grace")
    room.control.take(room.run, grace)
    room.control.release(room.run, grace)
    assert room.holder() == ""
    with pytest.raises(ControlError):
        room.control.release(room.run, grace)
    assert room.record()[-1] == ("grace", "", "grace", "free")


@pytest.mark.parametrize("account", ["lise", "ada"])
def test_who_only_looks_on_never_gets_control(room: Room, account: str) -> None:
    watcher = room.screen(account)
    for act in (room.control.take, room.control.ask):
        with pytest.raises(NotAllowedError):
            act(room.run, watcher)
    with pytest.raises(NotAllowedError):
        room.control.take_over(room.run, watcher, "because")
    assert room.record() == []


def test_an_unknown_run(room: Room) -> None:
    with pytest.raises(UnknownRunError):
        room.control.holder("nowhere")


def test_control_that_cannot_be_recorded_is_not_taken(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    grace = room.screen("grace")

    class NoRecordError(Exception):
        """The chain cannot be written."""

    def no_record(*_args: object, **_more: object) -> None:
        raise NoRecordError

    monkeypatch.setattr(Store, "append", no_record)
    with pytest.raises(NoRecordError):
        room.control.take(room.run, grace)
    assert room.holder() == ""
