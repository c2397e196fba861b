"""Evidence bundles and their stand-alone verifier: every change is named."""

from __future__ import annotations

import ast
import base64
import hashlib
import json
import random
import shutil
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import rfc8785
from hypothesis import example, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from service.audit.bundle.export import export_bundle
from service.audit.bundle.report import bundle_report
from service.audit.verify import bundle_verifier
from service.cli.evidence.audit import audit_app
from service.core.errors import DataError, IllegalTransitionError, IntegrityError
from service.core.records.events import EvidenceExported, RunReleased, StepNote
from service.store.files.artefacts import hash_file
from service.store.records import NewArtefact, NewJob
from service.store.signatures.signing import checkpoint, public_keys, rotate_key
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.runs.bench_run import PROTOCOL, begin_run

RECORDS = ("events.jsonl", "site_events.jsonl", "artefacts.jsonl", "jobs.jsonl", "checkpoints.jsonl", "keys.jsonl")


@dataclass(frozen=True)
class Site:
    """A data folder with a completed run, and its bundle, packed and unpacked."""

    data: Path
    run_id: str
    bundle: Path
    folder: Path
    key_id: str


def record(folder: Path, protocol: str = PROTOCOL) -> tuple[Path, str]:
    with Store.open(folder / "data") as store:
        bench = begin_run(store, protocol, folder)
        store.enqueue_job(bench.run_id, NewJob("detect", "fixation", 1, "key", {"of": "x"}), actor="runner")
        job = store.claim_job("worker 1", 10)
        assert job is not None
        ref = store.put_bytes(b"{}", kind="result", media_type="application/json", original_name="result.json")
        store.finish_job(job, measures={}, duration_s=1.0, artefacts=[NewArtefact(ref, "worker 1")])
        assert bench.run().status == "completed"
        checkpoint(store, bench.run_id)
        rotate_key(store, reason="yearly", actor="ada")
        return folder / "data", bench.run_id


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    folder = tmp_path_factory.mktemp("site")
    data, run_id = record(folder)
    shutil.copytree(data, folder / "before")
    with Store.open(data) as store:
        made = export_bundle(store, run_id, folder / "bundle.zip", actor="ada")
    with zipfile.ZipFile(made.path) as archive:
        archive.extractall(folder / "unpacked")
    return Site(data, run_id, made.path, folder / "unpacked", made.key_id)


@pytest.fixture
def unpacked(site: Site, tmp_path: Path) -> Path:
    shutil.copytree(site.folder, tmp_path / "bundle")
    return tmp_path / "bundle"


def check(path: Path, **options: Any) -> list[str]:
    """The faults that the verifier names when called in this process."""
    found = bundle_verifier.Check()
    found.run(path, options.get("key"), options.get("certificates"))
    return [f"{fault['where']}: {fault['what']}" for fault in found.faults]


def run_verifier(script: Path, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the verifier as elsewhere: nothing of this project can be imported."""
    words = [sys.executable, "-I", str(script), *arguments]
    return subprocess.run(words, cwd=cwd, capture_output=True, text=True, timeout=60, check=False)


# --- an untouched bundle ------------------------------------------------------------------------------------------


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
        *before, last = store.events(site.run_id)
        assert isinstance(last.payload, EvidenceExported)
        assert (last.actor, last.payload.what, last.payload.file_name) == ("ada", "bundle", site.bundle.name)
        assert (last.payload.sha256, last.payload.size_bytes) == hash_file(site.bundle)
        assert last.payload.head_sha256 == before[-1].sha256
        assert store.checkpoints(site.run_id)[-1].seq == last.seq
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
        shutil.copytree(site.data.with_name("before"), tmp_path / name)
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


# --- refused exports ---------------------------------------------------------------------------------------------


def test_altered_evidence_is_not_exported(site: Site, tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(site.data, data)
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
    shutil.copytree(site.data, data)
    (tmp_path / "b-SIMULATED.zip").write_text("mine")
    with Store.open(data) as store:
        with pytest.raises(DataError, match="exists"):
            export_bundle(store, site.run_id, tmp_path / "b.zip", actor="ada")

        def interrupted(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("service.audit.bundle.export.sign", interrupted)
        with pytest.raises(KeyboardInterrupt):
            export_bundle(store, site.run_id, tmp_path / "c.zip", actor="ada")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b-SIMULATED.zip", "data"]
    assert (tmp_path / "b-SIMULATED.zip").read_text() == "mine"


# --- tampering --------------------------------------------------------------------------------------------------


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_every_changed_file_is_named(unpacked: Path) -> None:
    names = [path for path in sorted(unpacked.rglob("*")) if path.is_file() and path.stat().st_size]
    assert len(names) > 15
    for path in names:
        name = path.relative_to(unpacked).as_posix()
        before = path.read_bytes()
        flip(path)
        try:
            found = check(unpacked)
        except bundle_verifier.NotABundleError as error:
            found = [str(error)]
        assert any(name in fault.split(": ")[0] for fault in found), (name, found)
        path.write_bytes(before)
    assert check(unpacked) == []


def test_a_manifest_of_random_bytes_is_told_in_few_words(unpacked: Path) -> None:
    (unpacked / "manifest.json").write_bytes(bytes(range(256)) * 40)
    with pytest.raises(bundle_verifier.NotABundleError, match="cannot be read: UnicodeDecodeError") as refused:
        check(unpacked)
    assert len(str(refused.value)) < 250


def test_every_missing_file_is_named_and_every_other_too(unpacked: Path) -> None:
    for path in [path for path in sorted(unpacked.rglob("*")) if path.is_file()]:
        name = path.relative_to(unpacked).as_posix()
        path.rename(unpacked.with_name("aside"))
        try:
            found = check(unpacked)
        except bundle_verifier.NotABundleError as error:
            found = [str(error)]
        assert any(name in fault for fault in found), (name, found)
        unpacked.with_name("aside").rename(path)
    (unpacked / "artefacts" / "notes.txt").write_text("hello")
    (unpacked / "link").symlink_to(unpacked / "README.txt")
    assert check(unpacked) == [
        "link: it is a link, not a file",
        "artefacts/notes.txt: it is in the bundle, but not in the manifest",
    ]


def seal(folder: Path) -> None:
    """Make the manifest consistent without the key: then only its signature is invalid."""
    crate = json.loads((folder / "ro-crate-metadata.json").read_text())
    for entity in crate["@graph"]:
        if "sha256" in entity and (folder / entity["@id"]).is_file():
            entity["sha256"], _ = hash_file(folder / entity["@id"])
    (folder / "ro-crate-metadata.json").write_bytes(rfc8785.dumps(crate))
    manifest = json.loads((folder / "manifest.json").read_text())
    for item in manifest["files"]:
        item["sha256"], item["size_bytes"] = hash_file(folder / item["path"])
    (folder / "manifest.json").write_bytes(rfc8785.dumps(manifest))


def change_lines(path: Path, change: Callable[[list[dict[str, Any]]], None]) -> None:
    records = [bundle_verifier.parse(line) for line in path.read_bytes().splitlines()]
    change(records)
    path.write_bytes(b"".join(bundle_verifier.canonical(record) + b"\n" for record in records))


def rewrite(records: list[dict[str, Any]]) -> None:
    """Change the person from the third event on, and make every hash and link consistent."""
    previous = ""
    for event in records[2:]:
        event["actor"] = "Eve" if not previous else event["actor"]
        event["previous_sha256"] = previous or event["previous_sha256"]
        del event["sha256"]
        previous = event["sha256"] = hashlib.sha256(rfc8785.dumps(event)).hexdigest()


FORGERIES: dict[str, tuple[str, Callable[[list[dict[str, Any]]], Any], str]] = {
    "event": ("events.jsonl", lambda r: r[2].update(actor="Eve"), "event 3: its content was altered"),
    "event left out": ("events.jsonl", lambda r: r.pop(3), "after event 3 comes event 5"),
    "last event left out": ("events.jsonl", lambda r: r.pop(), "it was left at event"),
    "events exchanged": ("events.jsonl", lambda r: r.insert(2, r.pop(3)), "missing or out of order"),
    "rewritten": ("events.jsonl", rewrite, "the chain was cut or rewritten"),
    "key": ("site_events.jsonl", lambda r: r[1]["payload"].update(key_id="0" * 64), "fingerprint"),
    "signed before": (
        "site_events.jsonl",
        lambda r: [e["payload"].update(sha256="0" * 64) for e in r if e["payload"]["kind"] == "run_signed"],
        "was signed once",
    ),
    "account": ("site_events.jsonl", lambda r: r[-1].update(actor="Eve"), "its content was altered"),
    "device of a file": ("artefacts.jsonl", lambda r: r[1].update(device="phone"), "the row was altered"),
    "row left out": ("artefacts.jsonl", lambda r: r.pop(3), "has no row"),
    "job": ("jobs.jsonl", lambda r: r[0].update(arguments={}), "differs from its event"),
    "job's state": ("jobs.jsonl", lambda r: r[0].update(state="failed"), "is failed, but event"),
    "job left out": ("jobs.jsonl", lambda r: r.pop(), "has no row"),
    "job invented": ("jobs.jsonl", lambda r: r.append({**r[0], "job_id": "x"}), "job x has no event"),
    "signature": (
        "checkpoints.jsonl",
        lambda r: r[-1].update(signature=base64.b64encode(b"0" * 64).decode()),
        "its signature is not valid",
    ),
    "signed by": ("checkpoints.jsonl", lambda r: r[-1].update(key_id="0" * 64), "is not in the site's chain"),
    "time of signing": ("checkpoints.jsonl", lambda r: r[-1].update(at_utc="2020"), "its signature is not valid"),
    "list of keys": ("keys.jsonl", lambda r: r.pop(), "does not list the keys"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_forged_records_are_named_and_cannot_be_signed(unpacked: Path, name: str) -> None:
    file, change, said = FORGERIES[name]
    change_lines(unpacked / file, change)
    seal(unpacked)
    found = check(unpacked)
    assert any(said in fault for fault in found), found
    assert "manifest.json, manifest.sig: the signature is not valid: the manifest was altered" in found


def test_another_spelling_of_a_record_is_named(unpacked: Path) -> None:
    path = unpacked / "events.jsonl"
    first, _, rest = path.read_bytes().partition(b"\n")
    path.write_bytes(first.replace(b'":', b'": ', 1) + b"\n" + rest)
    seal(unpacked)
    assert any("events.jsonl, line 1: it is not canonical JSON" in fault for fault in check(unpacked))


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of all values within a record."""
    if path:
        yield path
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(item, (*path, key))


def test_any_value_of_any_kind_in_any_place_is_named_and_breaks_nothing(unpacked: Path) -> None:
    chance = random.Random(4)
    other = [None, True, -1, 1.5, "", "x", "\0", [], {}, [1], {"a": 1}, "0" * 64]
    for _ in range(120):
        path = unpacked / chance.choice(RECORDS)
        before = {
            kept: (unpacked / kept).read_bytes() for kept in (path.name, "manifest.json", "ro-crate-metadata.json")
        }
        lines = before[path.name].splitlines()
        number = chance.randrange(len(lines))
        changed = bundle_verifier.parse(lines[number])
        *way, last = chance.choice(list(places(changed)))
        within = changed
        for key in way:
            within = within[key]
        within[last] = chance.choice([value for value in other if value != within[last]])
        lines[number] = bundle_verifier.canonical(changed)
        path.write_bytes(b"".join(line + b"\n" for line in lines))
        seal(unpacked)
        found = check(unpacked)
        said = [fault for fault in found if not fault.startswith("manifest.json, manifest.sig")]
        assert found, (path.name, number, way, last)
        # Jobs and keys are mostly covered by the chain; the rest of their rows only by the manifest.
        assert said or path.name in ("jobs.jsonl", "keys.jsonl"), (path.name, number, way, last)
        for name, content in before.items():
            (unpacked / name).write_bytes(content)


def test_a_protocol_of_another_run_and_a_real_looking_manifest_are_named(unpacked: Path) -> None:
    (unpacked / "protocol.yaml").write_text("id: other\n")
    manifest = json.loads((unpacked / "manifest.json").read_text())
    manifest["simulated"] = False
    (unpacked / "manifest.json").write_bytes(rfc8785.dumps(manifest))
    seal(unpacked)
    found = "\n".join(check(unpacked))
    assert "protocol.yaml: it is not the protocol file with which the run began" in found
    assert "disagree on whether it was simulated" in found


def test_a_forged_site_is_found_by_its_fingerprint_only(site: Site, tmp_path: Path) -> None:
    data, run_id = record(tmp_path)
    with Store.open(data) as store:
        forged = export_bundle(store, run_id, tmp_path / "forged.zip", actor="ada").path
        own = public_keys(store)
    assert check(forged) == []
    assert check(forged, key=own[0].key_id) == []  # an older key that vouches for the current one
    assert check(forged, key=":".join(own[1].key_id[i : i + 2].upper() for i in range(0, 64, 2))) == []
    (fault,) = check(forged, key=site.key_id)
    assert "knows no key" in fault


def test_a_lost_key_breaks_the_line_of_fingerprints(site: Site, tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(site.data, data)
    with Store.open(data) as store:
        next((data / "keys").iterdir()).unlink()
        rotate_key(store, reason="disk died", actor="ada", lost=True)
        bundle = export_bundle(store, site.run_id, tmp_path / "b.zip", actor="ada").path
    assert check(bundle) == []
    assert check(bundle, key=site.key_id)[0].startswith("--key: no unbroken line of signatures")


# --- containers that mean harm -------------------------------------------------------------------------------------


def zipped(folder: Path, target: Path, extra: Callable[[zipfile.ZipFile], None] | None = None) -> Path:
    with zipfile.ZipFile(target, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder).as_posix())
        if extra is not None:
            extra(archive)
    return target


def twice(archive: zipfile.ZipFile) -> None:
    with pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("README.txt", "other")


def link(archive: zipfile.ZipFile) -> None:
    info = zipfile.ZipInfo("link")
    info.external_attr = 0o120777 << 16
    archive.writestr(info, "/etc/passwd")


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (lambda archive: archive.writestr("../../etc/cron.d/x", "x"), "leads out of the bundle"),
        (lambda archive: archive.writestr("/etc/passwd", "x"), "leads out of the bundle"),
        (lambda archive: archive.writestr("a\\..\\b", "x"), "leads out of the bundle"),
        (lambda archive: archive.writestr("C:evil", "x"), "leads out of the bundle"),
        (lambda archive: archive.writestr("artefacts//x", "x"), "leads out of the bundle"),
        (lambda archive: archive.writestr("folder/", ""), "a folder, a link or a device"),
        (link, "a folder, a link or a device"),
        (twice, "holds this name twice"),
        (lambda archive: archive.writestr("bomb", b"\0" * 20_000_000, zipfile.ZIP_DEFLATED), "it would expand from"),
        (lambda archive: archive.writestr("more.txt", "x"), "not in the manifest"),
    ],
)
def test_harmful_entries_are_named_and_nothing_is_unpacked(
    unpacked: Path, tmp_path: Path, extra: Callable[[zipfile.ZipFile], None], said: str
) -> None:
    found = check(zipped(unpacked, tmp_path / "b.zip", extra))
    assert len([fault for fault in found if said in fault]) == 1, found
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.zip", "bundle"]


def test_a_declared_size_that_is_not_true_is_named(unpacked: Path, tmp_path: Path) -> None:
    bundle = zipped(unpacked, tmp_path / "b.zip")
    content = bytearray(bundle.read_bytes())
    at = content.rindex(b"events.jsonl", 0, content.rindex(b"site_events.jsonl")) - 46  # its central record
    assert content[at : at + 4] == b"PK\x01\x02"
    (size,) = struct.unpack_from("<I", content, at + 24)
    struct.pack_into("<I", content, at + 24, size - 10)
    bundle.write_bytes(content)
    assert any(fault.startswith("events.jsonl") for fault in check(bundle))


def test_broken_containers_are_refused_without_a_trace(site: Site, tmp_path: Path) -> None:
    script = site.folder / "verify.py"
    content = site.bundle.read_bytes()
    for name, made in {"cut": content[: len(content) // 2], "text": b"hello", "empty": b""}.items():
        (tmp_path / name).write_bytes(made)
        done = run_verifier(script, str(tmp_path / name), cwd=tmp_path)
        assert (done.returncode, done.stdout) == (2, ""), name
        assert "Traceback" not in done.stderr
    flipped = bytearray(content)
    flipped[len(content) // 3] ^= 0xFF
    (tmp_path / "flipped.zip").write_bytes(flipped)
    done = run_verifier(script, str(tmp_path / "flipped.zip"), cwd=tmp_path)
    assert done.returncode == 1, done.stdout
    assert "Traceback" not in done.stderr


# --- canonical JSON ----------------------------------------------------------------------------------------------

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53) + 1, 2**53 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), inner, max_size=4)
    ),
    max_leaves=10,
)


@given(VALUES)
@settings(deadline=None, max_examples=300)
@example({"\u20ac": 1, "\r": 2, "\ufb33": 3, "1": 4, "\U0001f600": 5, "\x80": 6, "\u00f6": 7})
@example('\x00\x1f\x7f\u2028/\\"\b\t\n\f\r')
def test_canonical_json_is_rfc_8785(value: object) -> None:
    text = bundle_verifier.canonical(value)
    assert text == rfc8785.dumps(value)  # pyright: ignore[reportArgumentType]  # any JSON value
    assert bundle_verifier.canonical(bundle_verifier.parse(text)) == text


@given(st.floats(allow_nan=False, allow_infinity=False))
@settings(deadline=None, max_examples=1000)
@example(1e21)
@example(123456789012345680000.0)
@example(9.999999999999999e22)
@example(1e-6)
@example(1.2e-7)
@example(5e-324)
@example(1.7976931348623157e308)
@example(-0.0)
@example(0.1 + 0.2)
@example(4.35)
def test_numbers_are_written_as_ecmascript_does(value: float) -> None:
    assert bundle_verifier.number(value).encode() == rfc8785.dumps(value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b'{"a":1,"a":2}', "twice"),
        (b"NaN", "no JSON"),
        (b"-Infinity", "no JSON"),
        (b"\xff", "utf-8"),
        (b"[" * 100_000, "too deeply"),
        (b"1" * 5000, "too long"),
    ],
)
def test_what_is_no_json_is_refused(text: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        bundle_verifier.parse(text)


# --- command line ------------------------------------------------------------------------------------------------


def test_the_command_exports_and_says_how_to_verify(site: Site, tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(site.data, data)
    words = ["export", "latest", str(tmp_path / "b.zip"), "--data", str(data), "--hashes-only", "--operator", "ada"]
    done = CliRunner().invoke(audit_app, words, env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.output
    assert f"python verify.py b-SIMULATED.zip --key {site.key_id}" in done.stdout
    done = CliRunner().invoke(audit_app, [*words, "--json"])
    assert done.exit_code == 1
    assert json.loads(done.stdout)["error"]["kind"] == "DataError"
    with Store.open(data) as store:
        store.record(site.run_id, [StepNote(step="capture", attempt=1, note="after")], actor="runner")
        assert verify(data, site.run_id).unsigned_events == {site.run_id: 1}
