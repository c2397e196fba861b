"""Evidence bundles: what they hold, when they are refused, and the verifier that finds them whole."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.audit import bundle_verifier
from service.audit.bundle import bundle_report, export_bundle
from service.cli.audit import audit_app
from service.core.errors import DataError, IllegalTransitionError, IntegrityError
from service.core.records.run_events import EvidenceExported, RunReleased, StepNote
from service.store.artefacts import hash_file
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.bundled_site import Site, check, record, run_verifier
from tests.support.record.outsider import copy_data
from tests.support.runs.bench_run import PROTOCOL

# --- an untouched bundle ---------------------------------------------------------------------------------


def test_the_verifier_in_the_bundle_finds_it_whole(site: Site, unpacked: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    done = run_verifier(unpacked / "verify.py", str(site.bundle), "--key", site.key_id, cwd=empty)
    assert (done.returncode, done.stderr) == (0, "")
    assert "WHOLE AND UNALTERED" in done.stdout
    assert "SIMULATED" in done.stdout
    done = run_verifier(unpacked / "verify.py", ".", "--json", cwd=unpacked)
    result = json.loads(done.stdout)
    assert (done.returncode, result["ok"], result["faults"], result["run_id"]) == (0, True, [], site.run_id)
    assert result["counts"]["artefacts"] >= 6
    assert list(empty.iterdir()) == []
    assert (unpacked / "verify.py").read_bytes() == Path(bundle_verifier.__file__).read_bytes()
    done = run_verifier(unpacked / "verify.py", str(empty), cwd=empty)
    assert (done.returncode, done.stdout) == (2, "")
    assert "not a bundle" in done.stderr


def test_the_verifier_needs_nothing_of_this_project_and_no_new_python() -> None:
    tree = ast.parse(Path(bundle_verifier.__file__).read_text(encoding="utf-8"), feature_version=(3, 9))
    imported = {
        (name.name if isinstance(node, ast.Import) else str(node.module)).split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in node.names
    }
    assert imported - set(sys.stdlib_module_names) == {"cryptography"}


def test_the_export_is_recorded_and_the_bundle_ends_before_it(site: Site) -> None:
    with Store.open(site.data) as store:
        events = store.events(site.run_id)  # other tests of this file export it again
        first = next(n for n, event in enumerate(events) if isinstance(event.payload, EvidenceExported))
        before, last = events[:first], events[first]
        assert isinstance(last.payload, EvidenceExported)
        assert (last.actor, last.payload.what, last.payload.file_name) == ("ada", "bundle", site.bundle.name)
        assert (last.payload.sha256, last.payload.size_bytes) == hash_file(site.bundle)
        assert last.payload.head_sha256 == before[-1].sha256
        assert last.seq in {signed.seq for signed in store.checkpoints(site.run_id)}
    manifest = json.loads((site.folder / "manifest.json").read_text())
    assert manifest["head"] == {"seq": before[-1].seq, "sha256": before[-1].sha256}
    assert verify(site.data, site.run_id).ok


def test_what_is_simulated_says_so_everywhere(site: Site) -> None:
    assert "SIMULATED" in site.bundle.name
    assert "SIMULATED" in (site.folder / "README.txt").read_text()
    assert json.loads((site.folder / "manifest.json").read_text())["simulated"] is True
    assert root_of(site.folder)["name"].startswith("SIMULATED")
    assert root_of(site.folder)["keywords"] == ["simulated"]


def root_of(folder: Path) -> dict[str, Any]:
    graph = json.loads((folder / "ro-crate-metadata.json").read_text())["@graph"]
    return next(item for item in graph if item["@id"] == "./")


def test_the_metadata_is_ro_crate(site: Site) -> None:
    crate = json.loads((site.folder / "ro-crate-metadata.json").read_text())
    graph = {item["@id"]: item for item in crate["@graph"]}
    assert crate["@context"][0] == "https://w3id.org/ro/crate/1.1/context"
    assert len(graph) == len(crate["@graph"])
    descriptor = graph["ro-crate-metadata.json"]
    assert descriptor["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    assert descriptor["about"] == {"@id": "./"}
    assert {"@type", "name", "description", "datePublished", "license"} <= set(graph["./"])
    for entity in graph.values():
        for value in entity.values():
            for item in value if isinstance(value, list) else [value]:
                if isinstance(item, dict) and entity["@id"] != "ro-crate-metadata.json":
                    reference = str(item["@id"])
                    assert reference in graph or reference.startswith("http"), reference
    files = {name for name, entity in graph.items() if entity["@type"] == "File"}
    present = {path.relative_to(site.folder).as_posix() for path in site.folder.rglob("*") if path.is_file()}
    assert files == present - {"manifest.json", "manifest.sig", "ro-crate-metadata.json"}
    assert {part["@id"] for part in graph["./"]["hasPart"]} == files
    for name in files:
        assert graph[name]["sha256"] == hash_file(site.folder / name)[0]
    actions = [entity for entity in graph.values() if entity["@type"] == "CreateAction"]
    assert any(action["name"] == "detect for fixation" and action["result"] for action in actions)
    assert sum(action["name"].startswith("Capture of") for action in actions) == 4
    assert {entity["name"] for entity in graph.values() if entity["@type"] == "Person"} >= {"Ada"}


def test_the_same_evidence_gives_the_same_bytes(site: Site, tmp_path: Path) -> None:
    made: list[bytes] = []
    with Store.open(site.data.with_name("before")) as store:
        checkpoint(store, "site")
    for name in ("one", "two"):
        copy_data(site.data.with_name("before"), tmp_path / name)
        report = bundle_report(tmp_path / name, site.run_id, with_pictures=True)
        with Store.open(tmp_path / name) as store:
            target = tmp_path / f"{name}.zip"
            made.append(export_bundle(store, site.run_id, target, actor="ada", report=report).path.read_bytes())
    assert made[0] == made[1]
    with zipfile.ZipFile(tmp_path / "one-SIMULATED.zip") as archive:
        html = archive.read("report.html").decode()
        head = json.loads(archive.read("manifest.json"))["head"]["sha256"]
    assert head in html
    assert "data:image/jpeg" in html


def test_hashes_alone_are_enough_to_verify_the_records(site: Site, tmp_path: Path) -> None:
    with Store.open(site.data) as store:
        report = bundle_report(site.data, site.run_id, with_pictures=False)
        made = export_bundle(store, site.run_id, tmp_path / "h.zip", actor="ada", hashes_only=True, report=report)
    with zipfile.ZipFile(made.path) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "hashes")
    html = (tmp_path / "hashes" / "report.html").read_text()
    assert made.head_sha256 in html
    assert "they were left out" in html.lower()
    assert "data:image" not in html
    assert not any(name.startswith("artefacts/") for name in names)
    assert check(made.path) == []
    (tmp_path / "hashes" / "report.html").write_text("<p>other</p>")
    assert check(tmp_path / "hashes")[0].startswith("report.html: it has")


def test_without_its_one_package_the_verifier_says_so() -> None:
    script = Path(bundle_verifier.__file__)
    done = subprocess.run(
        [sys.executable, "-I", "-S", str(script), "b.zip"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "`cryptography` is needed" in done.stderr


# --- refused exports -------------------------------------------------------------------------------------


def test_altered_evidence_is_not_exported(site: Site, tmp_path: Path) -> None:
    data = tmp_path / "data"
    copy_data(site.data, data)
    with Store.open(data) as store:
        image = next(item for item in store.artefacts(site.run_id) if item.ref.kind == "image")
        path = store.artefact_path(image.ref.sha256)
        path.chmod(0o644)
        path.write_bytes(b"other")
        events = len(store.events(site.run_id))
        with pytest.raises(IntegrityError, match=f"event {image.seq}, artefacts/.*the file has 5 bytes"):
            export_bundle(store, site.run_id, tmp_path / "b.zip", actor="ada")
        assert len(store.events(site.run_id)) == events
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_nothing_leaves_before_a_second_person_has_released_it(tmp_path: Path) -> None:
    protocol = PROTOCOL.replace("steps:", "release: second_person\nsteps:", 1)
    data, run_id = record(tmp_path, protocol)
    with Store.open(data) as store:
        with pytest.raises(IllegalTransitionError, match="second person"):
            export_bundle(store, run_id, tmp_path / "b.zip", actor="ada")
        completed = store.events(run_id)[-1]
        released = RunReleased(meaning="read and released", signed_sha256=completed.sha256)
        store.record(run_id, [released], actor="Ada")  # she took part in the run, so this has no effect
        with pytest.raises(IllegalTransitionError):
            export_bundle(store, run_id, tmp_path / "b.zip", actor="ada")
        store.record(run_id, [released], actor="Grace H.")
        assert check(export_bundle(store, run_id, tmp_path / "b.zip", actor="ada").path) == []


def test_nothing_is_overwritten_and_nothing_half_written_stays(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    copy_data(site.data, data)
    (tmp_path / "b-SIMULATED.zip").write_text("mine")
    with Store.open(data) as store:
        with pytest.raises(DataError, match="exists"):
            export_bundle(store, site.run_id, tmp_path / "b.zip", actor="ada")

        def interrupted(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("service.audit.bundle.sign", interrupted)
        with pytest.raises(KeyboardInterrupt):
            export_bundle(store, site.run_id, tmp_path / "c.zip", actor="ada")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b-SIMULATED.zip", "data"]
    assert (tmp_path / "b-SIMULATED.zip").read_text() == "mine"


# --- command line ----------------------------------------------------------------------------------------


def test_the_command_exports_and_says_how_to_verify(site: Site, tmp_path: Path) -> None:
    data = tmp_path / "data"
    copy_data(site.data, data)
    words = ["export", "latest", str(tmp_path / "b.zip"), "--data", str(data), "--hashes-only", "--operator", "ada"]
    done = CliRunner().invoke(audit_app, words, env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.output
    assert f"python -I verify.py b-SIMULATED.zip --key {site.key_id}" in done.stdout
    done = CliRunner().invoke(audit_app, [*words, "--json"])
    assert done.exit_code == 1
    assert json.loads(done.stdout)["error"]["kind"] == "DataError"
    with Store.open(data) as store:
        store.record(site.run_id, [StepNote(step="capture", attempt=1, note="after")], actor="runner")
        assert verify(data, site.run_id).unsigned_events == {site.run_id: 1}
