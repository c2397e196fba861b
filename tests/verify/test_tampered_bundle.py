"""Bundles that were tampered with, or that mean harm: the stand-alone verifier names every change."""

from __future__ import annotations

import base64
import hashlib
import json
import random
import re
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rfc8785

from service.audit import bundle_verifier
from service.audit.bundle import export_bundle
from service.store.artefacts import hash_file
from service.store.signatures.signing import public_keys, rotate_key
from service.store.store import Store
from tests.support.record.bundled_site import Site, check, record, run_verifier
from tests.support.record.outsider import copy_data

RECORDS = ("events.jsonl", "site_events.jsonl", "artefacts.jsonl", "jobs.jsonl", "checkpoints.jsonl", "keys.jsonl")


# --- tampering -------------------------------------------------------------------------------------------


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
    "device of a file": (
        "artefacts.jsonl",
        lambda r: r[1].update(device="phone"),
        "rig.yaml of event 1: the row was altered",
    ),
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
    files = {path.relative_to(unpacked).as_posix() for path in unpacked.rglob("*")}
    assert [fault for fault in found if re.split("[,:]", fault)[0] not in files] == []
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


@pytest.mark.slow
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
    for between in (":", " "):
        assert check(forged, key=between.join(own[1].key_id[i : i + 2].upper() for i in range(0, 64, 2))) == []
    (fault,) = check(forged, key=site.key_id)
    assert "knows no key" in fault


def test_a_lost_key_breaks_the_line_of_fingerprints(site: Site, tmp_path: Path) -> None:
    data = tmp_path / "data"
    copy_data(site.data, data)
    with Store.open(data) as store:
        next((data / "keys").iterdir()).unlink()
        rotate_key(store, reason="disk died", actor="ada", lost=True)
        bundle = export_bundle(store, site.run_id, tmp_path / "b.zip", actor="ada").path
    assert check(bundle) == []
    assert check(bundle, key=site.key_id)[0].startswith("--key: no unbroken line of signatures")


# --- containers that mean harm ---------------------------------------------------------------------------


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
