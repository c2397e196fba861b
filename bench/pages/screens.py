"""Takes screenshots of every page at tablet and desktop size, from a copy of a recorded run, into build/screens.

Those that a document shows are committed in docs/screens: `--into docs/screens --only 'run-hold|audit$|capture$'`.
"""

from __future__ import annotations

import argparse
import io
import re
import shutil
import sys
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from PIL import Image

from bench.machine import REPOSITORY
from bench.pages.retold import retell
from service.core.gates import evaluate_gates
from service.core.records.run_events import ItemTicked, OperatorAction, RecordCorrected, ViewpointCaptured
from service.people.person import Role
from service.people.sessions import People
from service.rig import Rig, load_rig
from service.run_start import recorded_run
from service.store.store import Store
from tests.support.pages.accounts import PASSWORD, add_people
from tests.support.pages.browser import DESKTOP, TABLET, Screen, chromium, screen, served
from tests.support.runs.attended import attended

FOLDER = REPOSITORY / "build" / "screens"
PEOPLE: tuple[tuple[str, Role], ...] = (("tina", "technician"), ("sam", "supervisor"), ("otto", "auditor"))
LIMIT_BYTES, QUALITY = 90_000, 80
PENDING_TRIES = 600  # half a second each: a data set's pictures take a while
STANDING = {
    "robot": "standing", "robot_name": "robot", "speed_fraction": 0.25, "camera_battery_fraction": 0.82,
    "light_lux": 812.0, "temperature_c": 21.4, "disk_free_bytes": 412_000_000_000,
}  # fmt: skip
# Name of the picture, whose screen, the page, what it shows. RUN… are the runs of `tell_runs`.
SHOTS: tuple[tuple[str, str, str, str], ...] = (
    ("sign-in", "", "/sign-in", "signing in"),
    ("set-up", "", "SET_UP", "an invited person sets up an account by a one-time link"),
    ("home", "tina", "/", "runs, and protocols to start"),
    ("start", "tina", "/start?protocol=demo.yaml", "what a run is of and for, before it starts"),
    ("checklist", "tina", "/protocols/demo.yaml/checklist", "a protocol as a checklist to print"),
    ("run", "tina", "/runs/RUN_LIST", "a step with its checklist"),
    ("run-hold", "tina", "/runs/RUN_HOLD", "the robot moves while the button is held"),
    ("run-working", "tina", "/runs/RUN_WORK", "the robot takes the images"),
    ("capture", "tina", "/runs/RUN_WORK/capture", "the last image with its spheres, and the plan of the viewpoints"),
    ("viewpoint", "tina", "/runs/RUN_WORK/capture?viewpoint=v1_003", "one viewpoint, to look at or to take again"),
    ("sign", "tina", "/runs/RUN_SIGN", "an irreversible step waits for a signature"),
    ("sign-dialog", "tina", "/runs/RUN_SIGN?dialog=sign", "what a signature binds"),
    ("recovery", "tina", "/runs/RUN_FAILED", "a step did not work: what happened, and what to do"),
    ("looking-on", "sam", "/runs/RUN_LIST", "another screen has control"),
    ("run-completed", "tina", "/runs/RUN_DONE", "the end of a run"),
    ("scene", "otto", "/runs/RUN_DONE/scene", "cameras, spheres, mesh and stations in one frame"),
    ("calibration", "otto", "/runs/RUN_DONE/calibration", "coverage, residuals and uncertainty of the calibration"),
    ("certificate", "otto", "/runs/RUN_DONE/calibration/certificate", "the certificate of a calibration"),
    ("data-set", "otto", "/runs/RUN_DONE/dataset", "photograph and depth of a view of the data set"),
    ("data-set-views", "otto", "/runs/RUN_DONE/dataset?split=sparse#views", "the views of a split, and their crops"),
    ("data-set-coverage", "otto", "/runs/RUN_DONE/dataset#coverage", "how many views see each place of the surface"),
    ("data-set-distances", "otto", "/runs/RUN_DONE/dataset#distances", "how far the CT is from the scan"),
    ("exports-formats", "sam", "/runs/RUN_DONE/exports#format-title", "export of the data set in a format"),
    ("exports", "sam", "/runs/RUN_DONE/exports", "release by a second person, and what leaves the system"),
    ("compare", "sam", "/compare?run=RUN_DONE&run=RUN_WORK", "two runs side by side"),
    ("history", "sam", "/history", "calibration and accuracy over time"),
    ("badges", "sam", "/badges", "badges that sign"),
    ("account", "tina", "/account", "one's own account"),
    ("accounts", "ada", "/accounts", "the people of the site, and its signing key"),
    ("account-administration", "ada", "/accounts/tina", "one account, as the administrator sees it"),
    ("audit-runs", "otto", "/audit", "all runs, with filters"),
    ("audit", "otto", "/audit/runs/RUN_DONE", "an auditor's first page of a run"),
    ("audit-gates", "otto", "/audit/runs/RUN_DONE/gates", "every gate with its limits and its figure"),
    ("audit-deviations", "otto", "/audit/runs/RUN_DONE/deviations", "every deviation with its reason"),
    ("audit-timeline", "otto", "/audit/runs/RUN_DONE/timeline", "every event, filtered and searched"),
    ("audit-event", "otto", "/audit/runs/RUN_DONE/events/300", "one event as it was recorded"),
    ("audit-artefacts", "otto", "/audit/runs/RUN_DONE/artefacts?kind=image", "every file with thumbnail and hash"),
    ("audit-artefact", "otto", "ARTEFACT", "one file, and what was made from it"),
    ("audit-provenance", "otto", "/audit/runs/RUN_DONE/provenance", "what each result came from"),
    ("audit-corrections", "otto", "/audit/runs/RUN_DONE/corrections", "old and new value of each correction"),
    ("audit-signatures", "otto", "/audit/runs/RUN_DONE/signatures", "who signed what"),
    ("audit-devices", "otto", "/audit/runs/RUN_DONE/devices", "devices, versions and clocks"),
    ("audit-verification", "otto", "/audit/runs/RUN_DONE/verification", "whether the evidence is unaltered"),
    ("audit-site", "otto", "/audit/site", "what happened outside of runs"),
    ("audit-site-event", "otto", "/audit/site/events/3", "one event of the site"),
    ("locked", "tina", "/runs/RUN_WORK#lock", "a locked screen still shows the capture"),
)  # fmt: skip
DARK = frozenset({"run-hold", "capture", "audit", "scene"})  # in dark mode, on the tablet
TABLET_ONLY = frozenset({"run-hold", "run-working", "viewpoint", "sign-dialog", "looking-on", "recovery", "locked"})


def main(words: Sequence[str] | None = None) -> int:
    """Take the screenshots and write a list of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="data folder with a completed simulated demo run")
    parser.add_argument("--rig", type=Path, required=True, help="its rig file")
    parser.add_argument("--into", type=Path, default=FOLDER)
    parser.add_argument("--only", default="", help="names to take, as a regular expression")
    options = parser.parse_args(words)
    options.into.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        shutil.copytree(options.data, data)
        taken = photograph(options.rig, data, options.into, re.compile(options.only))
    sys.stdout.write(f"{len(taken)} pictures, {sum(p.stat().st_size for p in taken) / 1e6:.2f} MB\n")
    if not options.only:
        (options.into / "README.md").write_text(listing(taken))
    return 0


def tell_runs(data: Path, rig: Rig) -> dict[str, str]:
    """Create runs of the technician Tina from the folder's first run; each stops at a point that a picture shows."""
    with Store.open(data) as store:
        source = store.runs()[0].run_id
        events = store.events(source)
        at = {(e.payload.kind, getattr(e.payload, "step", "")): e.seq for e in reversed(events)}
        payloads: list[Any] = [e.payload for e in events if isinstance(e.payload, ViewpointCaptured)]
        shots = [p for p in payloads if p.step == "viewpoint_capture_1"]
        seq_of = {e.payload.viewpoint: e.seq for e in events if isinstance(e.payload, ViewpointCaptured)}

        def told(end: int, more: dict[int, list[Any]] | None = None) -> str:
            return retell(store, source, rig, "tina", until=lambda e: e.seq >= end, more=more)

        third, fifth, last = shots[2], shots[4], shots[-2]
        redo = OperatorAction(
            action="redo", step=third.step, viewpoint=third.viewpoint, reason="A hand was in the picture", via="web"
        )
        again = {seq_of[fifth.viewpoint]: [redo, third]}
        done = told(events[-1].seq + 1, again)
        first: Any = next(e for e in store.events(done) if isinstance(e.payload, ViewpointCaptured))
        corrected = RecordCorrected(
            of_seq=first.seq, field="environment.temperature_c", old=first.payload.environment["temperature_c"],
            new=21.4, reason="The meter stood beside the lamp",
        )  # fmt: skip
        store.record(done, [corrected], actor="sam")
        runs = {
            "RUN_DONE": done,
            "RUN_LIST": told(at["step_started", "camera_set_up"] - 1),
            "RUN_FAILED": told(at["step_measured", "viewpoint_capture_1"]),
            "RUN_SIGN": told(at["operator_action", "spraying"]),
            "RUN_HOLD": told(at["step_started", "viewpoint_capture_2"] - 1),
            "RUN_WORK": told(seq_of[last.viewpoint], again),
        }
        protocol, _ = recorded_run(store, runs["RUN_LIST"])
        step = protocol.step("camera_set_up")
        ticks = [ItemTicked(step=step.id, attempt=1, item=item, ticked=True) for item in step.checklist[:2]]
        store.record(runs["RUN_LIST"], ticks, actor="tina")
        measured: Any = events[at["step_measured", "viewpoint_capture_1"] - 1].payload
        step = protocol.step("viewpoint_capture_1")
        measures = {**measured.measures, step.gates[0].measure: len(shots) - 4.0}
        failed = [measured.model_copy(update={"measures": measures}), evaluate_gates(step, 1, measures)]
        store.record(runs["RUN_FAILED"], failed, actor="runner")
        return runs


def _other_addresses(data: Path, run: str) -> dict[str, str]:
    """Addresses of an invitation and of a photograph of a run."""
    with Store.open(data) as store:
        people = People(store)
        token = people.sign_in("ada", PASSWORD)
        administrator = people.person(token, idle_lock_s=600, deliberate=True)
        assert administrator is not None
        link = people.accounts.invite(administrator, "tom", "Tom Example", "technician")
        files = [a for a in store.artefacts(run) if a.ref.kind == "image"]
    return {"SET_UP": f"/set-up/{link}", "ARTEFACT": f"/audit/runs/{run}/artefacts/{files[3].ref.sha256}"}


def _sign_in(shot: Screen, who: str, runs: Iterable[str]) -> None:
    """Sign in, unless nobody is meant to be; Tina takes control of all runs."""
    shot.page.set_default_timeout(60_000)
    if who:
        shot.sign_in(who)
    if who == "tina":
        for run_id in runs:
            take_control(shot, run_id)


def photograph(rig_file: Path, data: Path, into: Path, only: re.Pattern[str]) -> list[Path]:
    """Take every page at both sizes; returns the files."""
    add_people(data, PEOPLE)
    runs = tell_runs(data, load_rig(rig_file))
    names = runs | _other_addresses(data, runs["RUN_DONE"])
    working = STANDING | {"doing": "working", "robot": "moving", "what": "image", "done": 6, "total": 8}
    asking = STANDING | {"doing": "asking"}
    taken: list[Path] = []
    with served(rig_file, data) as server, chromium() as browser, ExitStack() as screens:
        for size, suffix in ((TABLET, "tablet"), (DESKTOP, "desktop")):
            before: dict[str, Screen] = {}
            for name, who, address, _ in SHOTS:
                path = address
                if not only.search(name) or (name in TABLET_ONLY and size != TABLET):
                    continue
                if who not in before:
                    before[who] = screens.enter_context(screen(browser, server.url, size))
                    _sign_in(before[who], who, runs.values())
                shot = before[who]
                for placeholder, text in names.items():
                    path = path.replace(placeholder, text)
                # A rig drives one run at a time.
                driven = [key for key in runs if key in address and key != "RUN_DONE"]
                with attended(data, {runs[key]: working if key == "RUN_WORK" else asking for key in driven}):
                    prepare(shot, path)
                    for dark in (False, True) if name in DARK and size == TABLET else (False,):
                        shot.page.emulate_media(color_scheme="dark" if dark else "light")
                        shot.page.wait_for_timeout(300)
                        target = into / f"{name}-{suffix}{'-dark' if dark else ''}.webp"
                        taken.append(write_small(shot.page.screenshot(), target))
                    shot.page.emulate_media(color_scheme="light")
            screens.close()
    return taken


def take_control(tablet: Screen, run_id: str) -> None:
    """Take control as the person in front of the screen does, also from another screen."""
    tablet.go(f"/runs/{run_id}")
    button = tablet.page.get_by_role("button", name=re.compile("Take control"))
    if button.count():
        button.first.click()
        tablet.page.wait_for_timeout(300)


def prepare(shot: Screen, path: str) -> None:
    """Load the page and wait until it is at rest."""
    shot.go(path.partition("#")[0])
    page = shot.page
    page.wait_for_load_state("load")
    for frame in page.query_selector_all("iframe"):
        frame.scroll_into_view_if_needed()
        page.wait_for_timeout(2500)
    page.evaluate("scrollTo(0, 0)")
    pending = page.locator("[data-pending]")
    for _ in range(PENDING_TRIES):
        if pending.count() == 0:
            break
        page.wait_for_timeout(500)
        page.reload()
    page.wait_for_timeout(400)
    part = path.partition("#")[2]
    if part and part != "lock":
        page.locator(f"#{part}").evaluate("e => e.scrollIntoView({ block: 'start', behavior: 'instant' })")
        page.wait_for_timeout(3000)  # for the surfaces in its frames
    if path.endswith("#lock"):
        page.get_by_role("button", name="Lock").click()
        page.wait_for_timeout(300)


def write_small(png: bytes, target: Path) -> Path:
    """Write a WebP in full colour; large photographs are reduced to two thirds of their size."""
    whole = Image.open(io.BytesIO(png)).convert("RGB")
    small = b""
    for scale in (1.0, 0.67):
        size = (round(whole.width * scale), round(whole.height * scale))
        picture = whole if scale == 1.0 else whole.resize(size, Image.Resampling.LANCZOS)
        buffer = io.BytesIO()
        picture.save(buffer, "WEBP", quality=QUALITY, method=6)
        small = buffer.getvalue()
        if len(small) <= LIMIT_BYTES:
            break
    target.write_bytes(small)
    return target


def listing(taken: Sequence[Path]) -> str:
    """Format the list of pictures, one per line."""
    what = {name: text for name, _, _, text in SHOTS}
    lines: list[str] = []
    for path in sorted(taken):
        shown = re.sub("-(tablet|desktop)(-dark)?$", "", path.stem)
        lines.append(f"- [{path.name}]({path.name}): {what[shown]}")
    return (
        "Pictures of every page at the size of a tablet (1024 × 768) and of a desktop (1920 × 1080), taken by\n"
        "bench/pages/screens.py from a simulated run.\n\n" + "\n".join(lines) + "\n"
    )


if __name__ == "__main__":
    raise SystemExit(main())
