"""The verifier in a bundle compares pose and joints of each view as the audit does, and says where it cannot."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from service.audit import bundle_verifier
from service.audit.bundle import FORMAT, MANIFEST_PREFIX
from service.audit.bundle_contents import crate_json, read_bundled_run, write_artefacts, write_records, writing_bundle
from service.core.arms import arm_model, flange_pose, known_arms
from service.core.geometry import transform
from service.core.records.run_events import DeviceOpened
from service.dataset.crate import METADATA
from service.run_start import recorded_run
from service.store.events import canonical
from service.store.records import SITE, NewArtefact
from service.store.signatures.signing import checkpoint, public_keys, sign
from service.store.store import Store
from service.store.verification.verify import AuditReport, verify
from tests.support.pages.states import BEGUN
from tests.support.record.bundled_site import run_verifier
from tests.support.record.store import captured, put_image
from tests.support.runs.bench_run import PROTOCOL, begin_run

JOINTS_RAD = (0.1, -1.2, 1.3, 0.4, 0.5, -0.2)
AWAY_M = 0.102
Bundled = Callable[[str, Sequence[tuple[str, float]]], tuple[AuditReport, Path]]


@pytest.fixture
def bundled(tmp_path: Path) -> Iterator[Bundled]:
    """Record views of an arm whose poses are so far off, in metres; return the audit's report and a bundle of it."""
    (tmp_path / "data").mkdir()
    with Store.open(tmp_path / "data") as store:

        def record(model: str, views: Sequence[tuple[str, float]]) -> tuple[AuditReport, Path]:
            run_id = begin_run(store, PROTOCOL, tmp_path).run_id
            identity = {"kind": "robot", "model": model, "serial": "1"}
            opened = DeviceOpened(device="robot", report={"identity": identity})
            store.record(run_id, [*BEGUN, opened], actor="runner")
            for name, away_m in views:
                ref = put_image(store, name)
                view = captured(ref, name, T_base_flange=_pose(away_m), joints_rad=JOINTS_RAD)
                store.record(run_id, [view], actor="runner", artefacts=[NewArtefact(ref, "camera", "capture", 1)])
            return verify(tmp_path / "data", run_id).with_limits(), _export(store, run_id, tmp_path / "bundle.zip")

        yield record


def _pose(away_m: float) -> tuple[tuple[float, ...], ...]:
    """The pose that a controller reports whose tool was moved at the pendant."""
    tool = transform(np.eye(3), np.array([0.0, 0.0, away_m]))
    return tuple(map(tuple, (flange_pose(arm_model("UR10e"), np.array(JOINTS_RAD)) @ tool).tolist()))


def _export(store: Store, run_id: str, target: Path) -> Path:
    """Export a run as a version did that judged no poses: today's exports nothing that the audit finds wrong."""
    checkpoint(store, run_id)
    checkpoint(store, SITE)
    protocol, root = recorded_run(store, run_id)
    with store.database.reading() as connection, writing_bundle(target, (2026, 11, 28, 12, 0, 0)) as bundle:
        run = read_bundled_run(connection, run_id, protocol, public_keys(store))
        write_records(bundle, store, connection, run)
        write_artefacts(bundle, store, run.artefacts, None)
        bundle.add(METADATA, [crate_json(run, bundle.listed)])
        manifest = {
            "format": FORMAT,
            "run_id": run_id,
            "simulated": root.simulated,
            "hashes_only": False,
            "head": {"seq": run.head.seq, "sha256": run.head.sha256},
            "site_head": {"seq": run.site_head.seq, "sha256": run.site_head.sha256},
            "made_by_key": run.keys[-1].key_id,
            "software": "",
            "files": [asdict(item) for item in bundle.listed],
        }
        signed = canonical(manifest).encode()
        bundle.add("manifest.json", [signed])
        bundle.add("manifest.sig", [sign(store, MANIFEST_PREFIX + signed)[1].encode() + b"\n"])
    return target


def _verified(bundle: Path) -> tuple[int, dict[str, list[dict[str, str]]], str]:
    """Verify a bundle as elsewhere: the exit status, the result as JSON, and as people read it."""
    script = Path(bundle_verifier.__file__)
    done = run_verifier(script, str(bundle), "--json", cwd=bundle.parent)
    return done.returncode, json.loads(done.stdout), run_verifier(script, str(bundle), cwd=bundle.parent).stdout


def test_a_view_recorded_with_a_changed_tool_is_named_as_by_the_audit(bundled: Bundled) -> None:
    report, bundle = bundled("UR10e", [("v1_001", 0.0), ("v1_002", AWAY_M), ("v1_003", 0.009)])
    (fault,) = report.faults
    status, result, text = _verified(bundle)
    assert (status, result["ok"], result["faults"]) == (1, False, [])  # all is as it was recorded
    assert result["contradictions"] == [{"where": f"events.jsonl, event {fault.seq}", "what": fault.what}]
    assert "the pose of v1_002 is 102 mm and 0.0°" in fault.what
    assert "WHOLE AND UNALTERED" in text
    assert "BUT 1 VIEW CANNOT BE RIGHT" in text


def test_a_view_that_was_taken_again_since_is_a_note_in_both(bundled: Bundled) -> None:
    report, bundle = bundled("UR10e", [("v1_001", AWAY_M), ("v1_001", 0.0)])
    assert report.ok
    status, result, _ = _verified(bundle)
    assert (status, result["contradictions"]) == (0, [])
    for notes in (report.notes, result["notes"]):
        assert [note for note in notes if "the pose of v1_001 is 102 mm" in note and "taken again since" in note]


@pytest.mark.parametrize("model", ["a bench arm", "LBR Med 14"])
def test_what_is_not_judged_is_said_and_counted(bundled: Bundled, model: str) -> None:
    report, bundle = bundled(model, [("v1_001", AWAY_M), ("v1_002", 0.0)])
    assert report.ok
    status, result, _ = _verified(bundle)
    assert status == 0
    for notes in (report.notes, result["notes"]):
        (said,) = [note for note in notes if "pose and joints of 2 views are not compared, because" in str(note)]
        assert model in said


def test_nothing_is_said_of_limits_where_all_was_judged(bundled: Bundled) -> None:
    report, bundle = bundled("UR10e", [("v1_001", 0.0)])
    _, result, _ = _verified(bundle)
    assert not [note for note in (*report.notes, *result["notes"]) if "not compared" in note]


def test_the_verifier_knows_the_arms_that_the_audit_judges() -> None:
    judged = {arm.name.lower(): arm for arm in known_arms() if arm.family == "universal_robot"}
    assert judged.keys() == bundle_verifier.ARMS.keys()
    rng = np.random.default_rng(29)
    for name, lengths in bundle_verifier.ARMS.items():
        for joints_rad in rng.uniform(-np.pi, np.pi, (20, 6)):
            own = bundle_verifier.flange_pose(lengths, joints_rad.tolist())
            assert np.allclose(own, flange_pose(judged[name], joints_rad), atol=1e-12)
