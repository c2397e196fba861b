"""The guided screen and the first page as a browser gets them."""

from __future__ import annotations

import re
from collections.abc import Generator
from pathlib import Path

import pytest

from service.core.records.run_events import (
    DeviceOpened,
    DeviceTrouble,
    ItemTicked,
    JobFailed,
    OperatorAction,
    RunAborted,
    SessionStarted,
    StepStarted,
)
from service.monitor.snapshot import Message, Snapshot, write_snapshot
from service.people.person import ROLES, Role
from service.store.records import NewJob
from tests.support.pages.web import WebSite, web_site

PARTS = ("banner", "control", "vitals", "step", "actions", "dialogs", "side")


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


@pytest.fixture
def run_id(web: WebSite) -> str:
    """A run that has begun, with a runner that asks."""
    begun = web.begin_run().run_id
    web.site.launcher.start(begun)
    tell(web, begun, doing="asking", robot="not_connected")
    return begun


def tell(web: WebSite, run_id: str, **fields: object) -> None:
    """Write a snapshot as a runner does."""
    write_snapshot(web.site.data, run_id, Snapshot.model_validate({"at_utc_s": web.now_utc_s, **fields}))


@pytest.mark.parametrize("role", ROLES)
def test_every_role_sees_the_run_and_only_operators_act(web: WebSite, run_id: str, role: Role) -> None:
    browser = web.browser(role)
    if role in ("technician", "supervisor"):
        web.take_control(run_id, browser)
    page = browser.get(f"/runs/{run_id}")
    assert page.status_code == 200
    assert "Fix the specimen" in page.text
    assert ('class="check"' in page.text) == (role in ("technician", "supervisor"))
    assert "Simulated" in page.text
    for part in PARTS:
        assert browser.get(f"/runs/{run_id}/parts/{part}").status_code == 200


def test_a_page_and_its_parts_say_the_same(web: WebSite, run_id: str) -> None:
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    page = browser.get(f"/runs/{run_id}").text
    together = browser.get(f"/runs/{run_id}/parts/{','.join(PARTS)}").text
    parts = dict(re.findall(r'<template data-part="(\w+)">(.*?)</template>', together, re.DOTALL))
    assert list(parts) == list(PARTS)
    for part, alone in parts.items():
        # Without times and the free space of the disk, which other tests use as well.
        strip = lambda text: re.sub(r"\s+|\d{4}-\d\d-\d\d[T ][\d:.+Z]*|UTC|[\d.]+ [MGT]B", "", text)  # noqa: E731
        assert strip(alone) in strip(page), part


def test_who_has_looked_at_a_lost_arm_says_so_on_any_page_and_ends_what_was_shown(web: WebSite, run_id: str) -> None:
    web.store.record(
        run_id,
        [
            DeviceOpened(device="robot", report={"identity": {"kind": "robot"}}),
            DeviceTrouble(device="robot", error="DeviceUnavailableError", message="died", connection="died"),
        ],
        actor="runner",
    )
    seq = web.store.head(run_id)
    technician, auditor = web.browser("technician"), web.browser("auditor")
    words = "The connection to robot was lost at"
    for address in (f"/runs/{run_id}", f"/runs/{run_id}/capture", "/"):
        page = technician.get(address).text
        assert words in page, address
        assert "Nothing has needed it so far" not in page
        assert "I have looked: robot stands still" in page
        assert "I have looked" not in auditor.get(address).text
    where = f"/runs/{run_id}/robot-seen"
    assert auditor.send_form(where, device="robot", lost_seq=seq).status_code == 403
    for stale in (0, seq - 1):
        assert technician.send_form(where, device="robot", lost_seq=stale).status_code == 409
    assert words in technician.get(f"/runs/{run_id}").text
    assert technician.send_form(where, device="robot", lost_seq=seq).status_code == 303
    page = technician.get(f"/runs/{run_id}").text
    assert "looked at it at" in page
    assert "I have looked" not in page
    (event,) = [event for event in web.store.events(run_id) if event.payload.kind == "robot_seen"]
    assert event.actor == web.account("technician")


def test_an_arm_that_nobody_has_looked_at_outlasts_its_run(web: WebSite, run_id: str) -> None:
    trouble = DeviceTrouble(device="robot", error="DeviceUnavailableError", message="died", connection="died")
    web.store.record(run_id, [trouble, RunAborted(reason="enough")], actor="runner")
    browser, seq = web.browser("technician"), web.store.head(run_id) - 1
    assert "Robot: take it as moving." in browser.get("/").text
    assert "The run has ended. The connection to robot was lost at" in browser.get(f"/runs/{run_id}").text
    assert browser.send_form(f"/runs/{run_id}/robot-seen", device="robot", lost_seq=seq).status_code == 303
    assert "Robot: take it as moving." not in browser.get("/").text
    assert "It drives no robot any more." in browser.get(f"/runs/{run_id}").text


def test_a_page_from_before_a_loss_confirms_no_motion(web: WebSite, run_id: str) -> None:
    """Whoever confirms a motion says to have looked at the arm, so the question must have said so."""
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    web.store.record(run_id, [OperatorAction(action="skip", step="fixation", reason="done before")], actor="grace")
    seen = web.store.head(run_id)
    trouble = DeviceTrouble(device="robot", error="DeviceUnavailableError", message="died", connection="died")
    web.store.record(run_id, [trouble], actor="runner")
    for seen_seq, status in ((seen, 409), (seen + 1, 303)):
        sent = browser.send_form(
            f"/runs/{run_id}/actions", verb="confirm", step="capture", attempt=1, seen_seq=seen_seq
        )
        assert sent.status_code == status


@pytest.mark.parametrize("verb", ["confirm", "resume"])
def test_a_page_from_before_a_restart_lets_no_arm_move_that_was_connected_then(
    web: WebSite, run_id: str, verb: str
) -> None:
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    arm = DeviceOpened(device="robot", report={"identity": {"kind": "robot"}})
    web.store.record(run_id, [OperatorAction(action="skip", step="fixation", reason="done before")], actor="grace")
    web.store.record(run_id, [arm], actor="runner")
    if verb == "resume":
        web.store.record(run_id, [OperatorAction(action="pause")], actor="grace")
    seen = web.store.head(run_id)
    web.store.record(run_id, [SessionStarted(resumed=True, software={}, host="h", pid=2)], actor="runner")
    for seen_seq, status in ((seen, 409), (seen + 1, 303)):
        sent = browser.send_form(f"/runs/{run_id}/actions", verb=verb, step="capture", attempt=1, seen_seq=seen_seq)
        assert sent.status_code == status


def test_two_screens_show_the_same_ticks(web: WebSite, run_id: str) -> None:
    acting, looking = web.browser("technician"), web.browser("supervisor")
    web.take_control(run_id, acting)
    answer = acting.send_form(f"/runs/{run_id}/ticks", step="fixation", attempt=1, item="wires hold", ticked="true")
    assert answer.status_code == 303
    assert acting.get(f"/runs/{run_id}").text.count('aria-checked="true"') == 1
    other = looking.get(f"/runs/{run_id}").text
    assert "word-ok" in other
    assert "has control" in other


def test_the_confirmation_of_a_motion_must_be_held(web: WebSite, run_id: str) -> None:
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    assert "data-hold" not in browser.get(f"/runs/{run_id}").text
    web.store.record(run_id, [OperatorAction(action="skip", step="fixation", reason="done before")], actor="grace")
    page = browser.get(f"/runs/{run_id}").text
    assert 'data-hold="1500"' in page
    assert "Confirm: the robot takes 4 images at station 1" in page
    assert page.count("data-hold") == 1


def test_asking_for_control_and_handing_over(web: WebSite, run_id: str) -> None:
    mine, other = web.browser("technician"), web.browser("supervisor")
    web.take_control(run_id, mine)
    assert other.send_form(f"/runs/{run_id}/control/ask", holder=mine.person.screen).status_code == 303
    assert "Hand over" in mine.get(f"/runs/{run_id}/parts/control").text
    asker = other.person.screen
    assert mine.send_form(f"/runs/{run_id}/control/answer", grant="true", asker=asker).status_code == 303
    assert "Confirm:" in other.get(f"/runs/{run_id}/parts/actions").text
    assert "Confirm:" not in mine.get(f"/runs/{run_id}/parts/actions").text


def test_dialogs_open_without_script(web: WebSite, run_id: str) -> None:
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    page = browser.get(f"/runs/{run_id}", params={"dialog": "abort"}).text
    assert re.search(r'<dialog id="dialog-abort"[^>]* open>', page)
    assert not re.search(r'<dialog id="dialog-abort"[^>]* open>', browser.get(f"/runs/{run_id}").text)


def test_ending_a_run_demands_a_reason_of_whatever_sends_the_form(web: WebSite, run_id: str) -> None:
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    for reason in ("", " \n"):
        refused = browser.send_form(f"/runs/{run_id}/actions", verb="abort", reason=reason)
        assert refused.status_code == 409
        assert "needs a reason" in refused.text
    assert not web.site.run(run_id).state.terminal
    assert browser.send_form(f"/runs/{run_id}/actions", verb="abort", reason="it fell").status_code == 303
    assert web.site.run(run_id).state.stop_reason == "it fell"


def test_a_stop_is_told_at_once_and_with_what_to_do(web: WebSite, run_id: str) -> None:
    tell(web, run_id, doing="asking", robot="emergency_stop", messages=(Message(at_utc="", text="stopped"),))
    banner = web.browser("auditor").get(f"/runs/{run_id}/parts/banner").text
    assert "data-alarm" in banner
    assert "cannot clear a stop" in banner
    assert "Emergency stop." in banner
    tell(web, run_id, doing="working", robot="moving")
    assert "This screen is not the emergency stop." in web.browser("auditor").get(f"/runs/{run_id}").text


def test_a_dead_runner_and_a_silent_one(web: WebSite) -> None:
    browser = web.browser("technician")
    begun = web.begin_run().run_id
    web.take_control(begun, browser)
    page = browser.get(f"/runs/{begun}").text
    assert "The program that drives the robot has stopped. Everything captured is safe." in page
    assert f'action="/runs/{begun}/go-on"' in page
    assert "Robot: unknown" in page


def test_an_ended_run_shows_how_it_ended(web: WebSite, run_id: str) -> None:
    web.store.record(run_id, [RunAborted(reason="the board <b>slipped</b>")], actor="runner")
    page = web.browser("auditor").get(f"/runs/{run_id}").text
    assert "The run was ended early" in page
    assert "the board &lt;b&gt;slipped" in page
    assert "data-stream" not in page
    assert "data-hold" not in page


def test_looking_at_another_step_changes_nothing(web: WebSite, run_id: str) -> None:
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    page = browser.get(f"/runs/{run_id}", params={"step": "spraying"}).text
    assert "Nothing can be changed here" in page
    assert "This cannot be undone" in page
    assert "Back to the current step" in page
    assert browser.get(f"/runs/{run_id}", params={"step": "../../etc"}).status_code == 200


def test_unknown_runs_and_parts(web: WebSite, run_id: str) -> None:
    browser = web.browser("technician")
    assert browser.get("/runs/20990101-000000-ffffff").status_code == 404
    assert browser.get(f"/runs/{run_id}/parts/secrets").status_code == 422


def test_the_first_page_lists_runs_and_starts_protocols(web: WebSite, run_id: str) -> None:
    ended = web.begin_run().run_id
    web.store.record(ended, [RunAborted(reason="no")], actor="runner")
    (web.site.protocols / "broken.yaml").write_text("id: [")
    page = web.browser("technician").get("/").text
    assert page.index(run_id) < page.index(ended)
    assert "A small procedure" in page
    assert "Cannot be started" in page
    assert 'href="/start?protocol=bench.yaml"' in page
    assert 'href="/start?protocol=bench.yaml"' not in web.browser("auditor").get("/").text


def test_the_theme_is_remembered_and_leads_nowhere_else(web: WebSite) -> None:
    browser = web.browser("auditor")
    answer = browser.send_form("/theme", theme="dark", back="//evil.example/")
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    assert 'data-theme="dark"' in browser.get("/").text
    assert browser.send_form("/theme", theme="dark", back="/audit").headers["location"] == "/audit"
    assert browser.send_form("/theme", theme="pink").status_code == 422


def test_pages_hold_no_inline_script_or_style(web: WebSite, run_id: str) -> None:
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    for address in ("/", f"/runs/{run_id}", f"/runs/{run_id}?step=capture"):
        page = browser.get(address).text
        assert not re.search(r"<script(?![^>]*\bsrc=)", page)
        assert not re.search(r"<[^>]*\s(style|on[a-z]+)=", page)


def test_ticks_of_others_reach_the_confirmation(web: WebSite, run_id: str) -> None:
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    ticks = [ItemTicked(step="fixation", attempt=1, item=item, ticked=True) for item in ("wires hold", "board lies")]
    web.store.record(run_id, ticks, actor="grace")
    actions = browser.get(f"/runs/{run_id}/parts/actions").text
    assert "disabled" not in actions


def test_the_step_says_how_long_it_takes_on_this_site(web: WebSite) -> None:
    web.begin_run().run()
    run_id = web.begin_run().run_id
    web.site.launcher.start(run_id)
    browser = web.browser("technician")
    page = browser.get(f"/runs/{run_id}").text
    assert "(one earlier run on this site)." in page
    assert "Work left: about" in page
    action = OperatorAction(action="skip", step="fixation", reason="done before")
    web.store.record(run_id, [action, OperatorAction(action="confirm", step="capture")], actor="grace")
    web.store.record(run_id, [StepStarted(step="capture", attempt=1)], actor="runner")
    tell(web, run_id, doing="working", robot="standing")
    page = browser.get(f"/runs/{run_id}").text
    assert re.search(
        r"Usually \d+ s \(one earlier run on this site\); started at \d\d:\d\d:\d\d UTC, so until about", page
    )


def test_a_computation_is_ended_by_whoever_controls_the_run_and_by_nobody_else(web: WebSite, run_id: str) -> None:
    job = NewJob("fuse", "fixation", 1, "fixation/0/fuse/x/0", {})
    web.store.record(run_id, [], actor="runner", jobs=[job])
    (enqueued,) = web.store.jobs(run_id)
    where = f"/runs/{run_id}/jobs/{enqueued.job_id}/cancel"
    technician, other, auditor = web.browser("technician"), web.browser("supervisor"), web.browser("auditor")
    web.take_control(run_id, technician)
    assert "ground-truth mesh of step fixation, in the queue" in auditor.get(f"/runs/{run_id}").text
    assert where not in auditor.get(f"/runs/{run_id}").text
    assert where in technician.get(f"/runs/{run_id}").text
    assert auditor.send_form(where, reason="it hangs").status_code == 403
    assert other.send_form(where, reason="it hangs").status_code in (403, 409)
    assert technician.send_form(where, reason=" ").status_code == 409
    assert [job.state for job in web.store.jobs(run_id)] == ["queued"]
    assert technician.send_form(where, reason="it hangs").status_code == 303
    assert technician.send_form(where, reason="it hangs").status_code == 409
    (end,) = [event for event in web.store.events(run_id) if isinstance(event.payload, JobFailed)]
    assert end.actor == web.account("technician")
    assert isinstance(end.payload, JobFailed)
    assert end.payload.message == f"{end.actor} cancelled it: it hangs"
    assert "ground-truth mesh of step fixation" not in technician.get(f"/runs/{run_id}").text
