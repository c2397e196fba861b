"""Whatever a person may do to a run on a page can be done in a terminal, and the other way round."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import typer
from typer.testing import CliRunner

from service.cli.act import ACTS
from service.cli.main import app
from service.core.records.run_events import (
    DeviceTrouble,
    ItemTicked,
    OperatorVerb,
    RecordCorrected,
    RegionDrawn,
    RobotSeen,
    RunReleased,
    SessionStarted,
)
from service.core.run.actions import VERBS
from service.store.store import Store
from tests.support.pages.web import WebSite, password_of, web_site
from tests.support.rig.rig import REPOSITORY
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store
from tests.support.runs.recorded_run import FUSION, record_run
from tests.support.runs.recorded_run import PROTOCOL as REGISTERED

# What a person does to a run on a page, by the name of its route → the command that does the same in a terminal.
IN_THE_TERMINAL = {
    "start_run": "run",
    "go_on": "resume",
    "act": "act confirm",
    "tick": "act tick",
    "robot_seen": "act seen",
    "ask_capture": "act finish",
    "cancel_job": "cancel",
    "end_wait": "accounts end-wait",
    "draw_region": "draw-region",
    "take_note": "note",
    "release": "audit release",
    "correct": "audit correct",
    "verify": "audit verify",
    "start_export": "audit export",
    "start_format_export": "export",
    "unfinished_export": "export",  # the terminal's ends with its command, and leaves nothing unfinished
    "stop_export": "export",
}
# What is of a screen alone: who is signed in at it, how it looks, and which of the screens drives a run.
OF_SCREENS = {
    *("sign_in", "sign_out", "lock", "unlock", "end_screen", "theme", "make_preview"),
    *("take_control", "ask_for_control", "answer_for_control", "release_control"),
}
# The accounts by which people sign in at screens are made and kept at a screen.
OF_ACCOUNTS = {
    *("set_up", "change_password", "change_pin", "enrol_badge", "revoke_badge", "report_badge_lost", "invite"),
    *("change_role", "disable_account", "enable_account", "reset_account"),
}
# What only a terminal on the data folder's machine does: it keeps the folder, whoever is signed in anywhere.
OF_THE_MACHINE = {
    *("demo", "serve", "worker", "doctor", "simulate", "dicom-listen", "import", "store", "protocol", "plan"),
    *("calibrate", "import-ros", "develop", "sfm", "register", "spheres", "layout", "fuse", "evaluate", "benchmark"),
    *("status", "runs", "compare", "history", "replay"),  # reading, which pages do in their own ways
    *(
        "audit show",
        "audit keys",
        "audit checkpoint",
        "audit rotate-key",
        "audit sign-here",
        "audit report",
        "audit figures",
    ),
}


def routes_that_change() -> set[str]:
    """The names of the routes by which a page changes something."""
    found: set[str] = set()
    for path in sorted((REPOSITORY / "service" / "web").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        named = re.findall(r'\.(?:post|put|patch|delete)\(\s*"[^"]+",\s*name="(\w+)"', text)
        assert len(named) == len(re.findall(r"@\w+\.(?:post|put|patch|delete)\(", text)), path
        found |= set(named)
    return found


def commands() -> set[str]:
    """The commands that can be typed, those of the groups `audit` and `accounts` each by its own name."""
    group = typer.main.get_group(app)
    found = set(group.list_commands(typer.Context(group))) - {"audit", "accounts"}
    for name in ("audit", "accounts"):
        of_group = group.resolve_command(typer.Context(group), [name])[1]
        assert of_group is not None
        found |= {f"{name} {command}" for command in of_group.commands}  # type: ignore[attr-defined]
    return found


def test_every_act_of_a_page_has_its_command() -> None:
    assert routes_that_change() == set(IN_THE_TERMINAL) | OF_SCREENS | OF_ACCOUNTS
    for command in IN_THE_TERMINAL.values():
        if command.startswith("act "):
            assert command.removeprefix("act ") in ACTS
        else:
            assert command in commands()


def test_every_act_of_the_terminal_has_its_page() -> None:
    acting = {command for command in IN_THE_TERMINAL.values() if not command.startswith("act ")} | {"act"}
    assert commands() == acting | OF_THE_MACHINE
    assert set(ACTS) == {*VERBS, "release", "finish", "tick", "untick", "seen"}
    assert set(VERBS) == set(get_args(OperatorVerb))  # which the page's form takes, one and all


# --- the acts themselves -------------------------------------------------------------------------------------


def call(data: Path, *words: str, typed: str = "") -> tuple[int, dict[str, Any]]:
    done = CliRunner().invoke(app, [*words, "--data", str(data), "--json"], input=typed, catch_exceptions=False)
    return done.exit_code, json.loads(done.stdout)


def payloads(data: Path, kind: type[Any], run: str = "latest") -> list[tuple[str, Any]]:
    with Store.open(data) as store:
        events = store.events(store.find_run(run))
    return [(event.actor, event.payload) for event in events if isinstance(event.payload, kind)]


def test_a_run_of_the_terminal_is_released_by_a_second_person_and_exported(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with bench_store(data) as store:
        bench = begin_run(store, PROTOCOL.replace("steps:", "release: second_person\nsteps:", 1), tmp_path)
        assert bench.run().status == "completed"
    words = ["audit", "export", "latest", str(tmp_path / "b.zip"), "--operator", "Grace H."]
    assert call(data, *words)[0] == 1
    status, told = call(data, "audit", "release", "--operator", "Grace H.")
    assert (status, told["released"]) == (0, False)
    assert "in which nothing deviated from the protocol" in told["meaning"]
    assert payloads(data, RunReleased) == []
    status, told = call(data, "audit", "release", "--yes", "--operator", "Ada")  # who ran it
    assert (status, told["error"]["kind"]) == (1, "IllegalTransitionError")
    status, told = call(data, "audit", "release", "--yes", "--operator", "Grace H.")
    assert (status, told["released"]) == (0, True)
    ((by, released),) = payloads(data, RunReleased)
    assert (by, released.identified, released.meaning) == ("Grace H.", "claimed", told["meaning"])
    assert call(data, "audit", "release", "--yes", "--operator", "Linus")[0] == 1  # it is released already
    status, told = call(data, *words)
    assert status == 0, told
    assert call(data, "audit", "verify")[0] == 0


def test_evidence_that_does_not_verify_is_not_released(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with bench_store(data) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.run()
        image = next(item for item in store.artefacts(bench.run_id) if item.ref.kind == "image")
        path = store.artefact_path(image.ref.sha256)
    path.chmod(0o644)
    path.write_bytes(b"other")
    status, told = call(data, "audit", "release", "--yes", "--operator", "Grace H.")
    assert (status, told["error"]["kind"]) == (1, "IntegrityError")
    assert payloads(data, RunReleased) == []


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebSite]:
    with web_site(tmp_path_factory.mktemp("web")) as made:
        yield made


@pytest.fixture(scope="module")
def completed(site: WebSite) -> str:
    return site.record_run(PROTOCOL.replace("steps:", "release: second_person\nsteps:", 1))


@pytest.mark.slow
@pytest.mark.parametrize("act", ["release", pytest.param("correct", marks=pytest.mark.sweep)])
def test_where_accounts_exist_only_the_role_may_and_only_with_its_password(
    site: WebSite, completed: str, act: str
) -> None:
    data = site.folder / "data"
    words = {
        "release": ["audit", "release", completed, "--yes"],
        "correct": ["audit", "correct", "1", "operator", "Lin", "--run", completed, "--reason", "misspelt"],
    }[act]
    kind = {"release": RunReleased, "correct": RecordCorrected}[act]
    for name, typed in (
        ("A Stranger", ""),
        (site.account("technician"), password_of(site.account("technician"))),
        (site.account("supervisor"), "guessed"),
    ):
        status, told = call(data, *words, "--operator", name, "--password-stdin", typed=f"{typed}\n")
        assert status == 1, (name, told)
        assert payloads(data, kind, completed) == []
    name = site.account("supervisor")
    status, told = call(data, *words, "--operator", name, "--password-stdin", typed=f"{password_of(name)}\n")
    assert status == 0, told
    ((by, _),) = payloads(data, kind, completed)
    assert by == name


def test_an_item_is_ticked_and_unticked(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with bench_store(data) as store:
        begin_run(store, PROTOCOL, tmp_path)
        store.record(
            store.find_run("latest"), [SessionStarted(resumed=False, host="h", pid=1, software={})], actor="runner"
        )
    assert call(data, "act", "tick", "--item", "wires", "--operator", "Ada")[0] == 0
    assert call(data, "act", "tick", "--item", "wires hold", "--operator", "Ada")[0] == 0  # it is ticked already
    assert call(data, "act", "tick", "--item", "nothing", "--operator", "Ada")[0] == 1
    assert call(data, "act", "tick", "--operator", "Ada")[0] == 1
    assert call(data, "act", "untick", "--item", "wires hold", "--operator", "Ada")[0] == 0
    assert [(by, tick.item, tick.ticked) for by, tick in payloads(data, ItemTicked)] == [
        ("Ada", "wires hold", True),
        ("Ada", "wires hold", False),
    ]


def test_an_arm_that_was_lost_is_seen(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with bench_store(data) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        lost = DeviceTrouble(device="robot", error="DeviceUnavailableError", message="died", connection="died")
        store.record(
            bench.run_id, [SessionStarted(resumed=False, host="h", pid=1, software={}), lost], actor="runner"
        )
        seq = store.head(bench.run_id)
    assert call(data, "act", "seen", "--device", "other", "--operator", "Ada")[0] == 1
    assert call(data, "act", "seen", "--operator", "Ada")[0] == 0
    ((by, seen),) = payloads(data, RobotSeen)
    assert (by, seen.device, seen.lost_seq) == ("Ada", "robot", seq)
    assert call(data, "act", "seen", "--operator", "Ada")[0] == 1  # nothing is lost any more


@pytest.mark.slow
def test_a_region_is_drawn(tmp_path: Path) -> None:
    data = tmp_path / "data"
    record_run(tmp_path, complete=False, protocol=REGISTERED + FUSION)
    corners = "[[0.01, 0.0, 0.02], [0.03, 0.0, 0.02], [0.02, 0.02, 0.025]]"
    words = ["--source", "ct", "--along", "[0, 0, 1]", "--operator", "Ada"]
    assert call(data, "draw-region", "[[0, 0, 0]]", *words)[0] == 1
    assert call(data, "draw-region", corners, *words)[0] == 0
    ((by, region),) = payloads(data, RegionDrawn)
    assert (by, region.source, len(region.corners_m)) == ("Ada", "ct", 3)
