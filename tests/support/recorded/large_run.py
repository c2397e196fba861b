"""A consistent run of any length: every action is allowed by the lifecycle and every hash is right."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from service.audit.background import PartialProgress
from service.audit.overview import Digest, digests
from service.core.gates import evaluate_gates
from service.core.protocol import Step, load_protocol
from service.core.records.base import ArtefactRef
from service.core.records.events import Payload
from service.core.records.run_events import (
    ActionRefused,
    ControlTaken,
    DeviceOpened,
    DeviceTrouble,
    EvidenceExported,
    FilesKept,
    OperatorAction,
    RecordCorrected,
    RunCompleted,
    SessionStarted,
    StepMeasured,
    StepNote,
    StepPassed,
    StepStarted,
    ViewpointCaptured,
    ViewpointFailed,
)
from service.core.run.actions import record_to_sign
from service.core.run.fold import DECISIVE_EVENTS, advance, initial_state
from service.core.run.state import RunState
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.database.engine import database_path
from service.store.durable_effects import DurableFiles
from service.store.records import NewArtefact, NewJob
from service.store.signatures.signing import checkpoint
from service.store.store import Store

PROTOCOL = Path(__file__).parents[3] / "protocols" / "demo.yaml"
EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
BATCH = 500  # events per transaction
SOFTWARE = {f"package-{number}": f"1.{number}.0" for number in range(70)} | {"orthocapture": "0.1.0"}
LIGHTBOX = {
    "identity": {"kind": "lightbox", "model": "ORTHO-LB1", "serial": "LB-1", "firmware": "1.2", "driver": "lightbox"},
    "problems": [],
}


class QuickFiles(DurableFiles):
    """Writes without waiting for the disk, since the data are for measurements and are not kept."""

    def sync_file(self, path: Path) -> None:
        pass

    def sync_directory(self, path: Path) -> None:
        pass


@dataclass
class Sizes:
    """The numbers of everything in the run."""

    events: int = 100_000
    slices: int = 3000
    viewpoints: int = 2500  # two files each
    jobs: int = 1995  # one file each
    failures: int = 1500
    troubles: int = 1000
    pauses: int = 2000  # each with its resume
    refused: int = 600
    redone_viewpoints: int = 300
    corrections: int = 120


@dataclass
class LargeRun:
    """Writes one run."""

    store: Store
    run_id: str
    state: RunState
    protocol: Any
    draw: random.Random = field(default_factory=lambda: random.Random(4))
    waiting: list[tuple[Payload, str, tuple[NewArtefact, ...]]] = field(
        default_factory=list[tuple[Payload, str, tuple[NewArtefact, ...]]]
    )

    def add(self, payload: Payload, actor: str = "runner", *artefacts: NewArtefact) -> None:
        """Append a payload with the next batch."""
        if self.waiting and (len(self.waiting) >= BATCH or self.waiting[-1][1] != actor):
            self.flush()
        self.waiting.append((payload, actor, artefacts))

    def flush(self) -> None:
        """Append the pending batch in one transaction, and update the state."""
        if not self.waiting:
            return
        payloads = [payload for payload, _actor, _artefacts in self.waiting]
        artefacts = [artefact for _payload, _actor, brought in self.waiting for artefact in brought]
        for event in self.store.record(self.run_id, payloads, actor=self.waiting[0][1], artefacts=artefacts):
            if event.payload.kind in DECISIVE_EVENTS:
                self.state = advance(self.protocol, replace(self.state, seq=event.seq - 1), event)
        self.waiting = []

    def act(self, action: str, actor: str = "Ada", **fields: Any) -> None:
        """Append a person's action."""
        self.add(OperatorAction.model_validate({"action": action, "via": "web", **fields}), actor)

    def begin(self, step: Step) -> None:
        """Append signature and confirmation as the protocol requires, then the step's start."""
        self.flush()
        if step.irreversible and step.sign:
            self.act(
                "sign", step=step.id, meaning="released", signed_sha256=record_to_sign(self.protocol, self.state)
            )
        if step.confirm:
            self.act("confirm", step=step.id, checklist=step.checklist)
        self.flush()
        self.add(StepStarted(step=step.id, attempt=self.state.step.attempt))

    def end(self, step: Step, artefacts: tuple[ArtefactRef, ...] = ()) -> None:
        """Append measures within all limits, gates, signature and pass."""
        self.flush()
        attempt = self.state.step.attempt
        measures = {gate.measure: _within(gate.min, gate.max) for gate in step.gates}
        self.add(StepMeasured(step=step.id, attempt=attempt, measures=measures, artefacts=artefacts))
        self.add(evaluate_gates(step, attempt, measures, self.state.skipped))
        self.flush()
        if step.sign and not self.state.step.signed:
            self.act("sign", step=step.id, meaning="read", signed_sha256=record_to_sign(self.protocol, self.state))
            self.flush()
        self.add(StepPassed(step=step.id, attempt=attempt))
        self.flush()

    def keep(self, kind: str, name: str, size: int, media_type: str = "application/octet-stream") -> ArtefactRef:
        """Store a file of noise."""
        return self.store.put_bytes(self.draw.randbytes(size), kind=kind, media_type=media_type, original_name=name)


def _within(low: float | None, high: float | None) -> float:
    if low is not None and high is not None:
        return (low + high) / 2
    return low if low is not None else (high if high is not None else 0.0)


def write_large_run(data: Path, sizes: Sizes) -> str:
    """Write the run to a data folder, from its first event to its last; returns its id."""
    data.mkdir(parents=True, exist_ok=True)
    (data / "rig.yaml").write_text("name: large\nsimulated: true\ndevices: {}\n")
    loaded = load_protocol(PROTOCOL, params_models())
    with Store.open(data, files=QuickFiles()) as store:
        run_id = start_run(store, loaded, load_rig(data / "rig.yaml"), operator="Ada", auto_confirm=False)
        state = initial_state(loaded.protocol)
        root = store.events(run_id)[0]
        run = LargeRun(store, run_id, advance(loaded.protocol, state, root), loaded.protocol)
        run.add(SessionStarted(resumed=False, software=SOFTWARE, host="here", pid=1))
        run.add(DeviceOpened(device="lightbox", report=LIGHTBOX))
        for step in loaded.protocol.steps:
            run.begin(step)
            brought: tuple[ArtefactRef, ...] = ()
            if step.id == "ct_import":
                _slices(run, step, sizes)
            elif step.id == "viewpoint_capture_1":
                brought = _captures(run, step, sizes)
            run.end(step, brought)
        run.add(RunCompleted(deviations=len(run.state.deviations)))
        run.flush()
        checkpoint(store, run_id)
        head = run.store.runs()[-1]
        for number in range(sizes.corrections):
            run.add(
                RecordCorrected(of_seq=2, field="host", old="here", new=f"there {number}", reason="misnamed"), "Grace"
            )
        run.add(
            EvidenceExported(
                what="report", file_name="a.pdf", sha256="0" * 64, size_bytes=1, head_sha256=head.head_sha256
            ),
            "Grace",
        )
        run.flush()
        return run_id


def _slices(run: LargeRun, step: Step, sizes: Sizes) -> None:
    for number in range(sizes.slices):
        ref = run.keep("ct_slice", f"CT{number:05d}.dcm", 300, "application/dicom")
        kept = FilesKept(step=step.id, attempt=1, device="ct", note=f"kept {ref.original_name}", artefacts=(ref,))
        run.add(kept, "runner", NewArtefact(ref, "ct", step.id, 1))


def _captures(run: LargeRun, step: Step, sizes: Sizes) -> tuple[ArtefactRef, ...]:
    images: list[str] = []
    refs: list[ArtefactRef] = []
    for number in range(sizes.viewpoints):
        name = f"v{number:05d}"
        refs.append(_capture(run, step, name, number))
        images.append(refs[-1].sha256)
        if number < sizes.jobs:
            _job(run, step, images)
        if number < sizes.failures:
            failed = ViewpointFailed(
                step=step.id,
                attempt=1,
                viewpoint=f"w{number:05d}",
                error="StillnessError",
                message="the arm moved",
                skipped=number % 6 == 0,
            )
            run.add(failed)
        if number < sizes.troubles:
            run.add(DeviceTrouble(device="robot", error="RobotStopError", message=f"protective stop {number}"))
        if number < sizes.pauses:
            run.act("pause", "Grace" if number % 3 else "Ada")
            run.act("resume", "Ada")
        if number < sizes.refused:
            run.add(ActionRefused(action="skip", step=step.id, why=f"no reason was given, time {number}"), "Ada")
        if number < sizes.redone_viewpoints:
            run.act("redo", step=step.id, viewpoint=name, reason=f"a hand in the picture {number}")
            run.flush()
            refs.append(_capture(run, step, name, number))
            run.add(ControlTaken(screen=f"tablet-{number % 5}", previous="", how="free"), "Grace")
    run.flush()
    _notes(run, step, sizes.events - run.store.runs()[-1].head_seq - sizes.corrections - 90)
    return tuple(refs[:50])


def _notes(run: LargeRun, step: Step, count: int) -> None:
    words: Sequence[str] = ("station", "entered", "timer", "light", "temperature", "waiting", "moving", "settled")
    for number in range(max(count, 0)):
        note = " ".join(run.draw.sample(words, 3))
        run.add(
            StepNote(step=step.id, attempt=1, note=note, data={"number": number, "where": f"station_{number % 4}"})
        )
    run.flush()


def _capture(run: LargeRun, step: Step, name: str, number: int) -> ArtefactRef:
    image = run.keep("image", f"DSC{number:05d}.JPG", 600, "image/jpeg")
    log = run.keep("pose_log", f"{name}.poses.jsonl", 200)
    captured = ViewpointCaptured(
        step=step.id,
        attempt=1,
        viewpoint=name,
        station=f"station_{number % 3}",
        artefacts=(image, log),
        T_base_flange=EYE,
        pose_sigma_m=1e-5,
        pose_sigma_rad=2e-5,
        joints_rad=tuple(run.draw.random() for _ in range(6)),
        pose_samples=46,
        trigger_monotonic_s=1.25 * number,
        arrival_monotonic_s=1.25 * number + 1,
        controller_time_s=50.0 + number,
        clock_offset_s=-23048.89 + 1e-6 * number,
        camera={"iso": 100, "exposure_s": 1 / 15, "lens": "FE 24-70mm F2.8 GM", "exif_time": "2026:11:21 10:08:02"},
        environment={"light_lux": 46764.2, "temperature_c": 22.19},
        verdicts={"still": True, "settings": True},
    )
    run.add(
        captured,
        "runner",
        NewArtefact(image, "camera", step.id, 1, name),
        NewArtefact(log, "robot", step.id, 1, name),
    )
    return image


def _job(run: LargeRun, step: Step, images: list[str]) -> None:
    run.flush()
    arguments = {"images": images[-20:], "camera": {"fx_px": 2148.912345678901}}
    new = NewJob("live_view", step.id, 1, f"live/{len(images)}", arguments)
    run.store.record(run.run_id, [], actor="runner", jobs=[new])
    job = run.store.claim_job("worker", 60.0)
    assert job is not None
    ref = run.keep("live_view", f"live_{len(images):05d}.json", 150, "application/json")
    run.store.finish_job(
        job, measures={"spheres": 13.0}, duration_s=0.4, artefacts=[NewArtefact(ref, "worker", step.id, 1)]
    )


def database_bytes(data: Path) -> int:
    """Size of the database."""
    return database_path(data).stat().st_size


SMALL = Sizes(
    events=1200,
    slices=20,
    viewpoints=30,
    jobs=12,
    failures=14,
    troubles=5,
    pauses=8,
    refused=9,
    redone_viewpoints=4,
    corrections=3,
)


def digest_of(store: Store, run: str) -> Digest:
    """The digest of a run, waited for."""
    computed = digests(store)
    value = computed.get(run, wait_s=60.0)
    computed.close()
    assert not isinstance(value, PartialProgress)
    return value
