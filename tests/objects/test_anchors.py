"""The evidence anchored by object lock in a real object store: every forgery against it, and what each shows."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from service.audit.overview import verified
from service.audit.verifications import verification_of
from service.cli.main import app
from service.store.durable_effects import SystemClock, utc_text
from service.store.objects.anchors import (
    ROOTS,
    AnchorWriter,
    LineAnchor,
    LockedObjects,
    RootAnchor,
    line_name,
    merkle_root,
)
from service.store.objects.interface import ObjectStoreError
from service.store.objects.s3 import S3Objects
from service.store.objects.upload import Uploader
from service.store.signatures.log import NAME as LOG
from service.store.signatures.log import read_log
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.anchor_checks import ReadAnchors, RecordSide, compare, read_anchors
from service.store.verification.verify import AuditReport, verify
from tests.support.processes.object_store import Weed
from tests.support.processes.postgres import Cluster
from tests.support.record.outsider import copy_data, tamper
from tests.support.record.store import start_run

LOCKED_DAYS = 2


@pytest.fixture(scope="module")
def bucket(weed: Weed) -> str:
    """One bucket with object lock for the whole file; a bucket takes volumes of its own."""
    weed.bucket("locked", lock=True)
    return "locked"


@dataclass
class Site:
    """A data folder with two signed runs, whose evidence is anchored."""

    data: Path
    objects: S3Objects
    weed: Weed

    @property
    def locked(self) -> LockedObjects:
        return LockedObjects(self.objects)

    def lines(self) -> list[bytes]:
        return (self.data / LOG).read_bytes().splitlines()

    def key(self, name: str) -> str:
        return f"{self.objects.prefix}/{name}"

    def sign_another_run(self) -> str:
        with Store.open(self.data) as store:
            run_id = start_run(store)
            checkpoint(store, run_id)
        return run_id

    def anchor(self) -> int:
        with Store.open(self.data) as store:
            return AnchorWriter(store, self.locked, LOCKED_DAYS).write()

    def section(self, **changed: object) -> None:
        site = yaml.safe_load((self.data / "site.yaml").read_text())
        site["object_store"] |= changed
        (self.data / "site.yaml").write_text(yaml.safe_dump(site))

    def faults(self) -> str:
        return "\n".join(str(fault) for fault in verify(self.data).faults)


@pytest.fixture
def site(weed: Weed, bucket: str, tmp_path: Path) -> Site:
    objects = weed.write_site(tmp_path / "data", bucket=bucket, lock_days=LOCKED_DAYS)
    made = Site(tmp_path / "data", objects, weed)
    made.sign_another_run()
    made.sign_another_run()
    made.anchor()
    return made


def test_every_line_and_the_ends_of_the_day_are_locked_and_compared(site: Site) -> None:
    versions = list(site.locked.versions("anchors/"))
    today = f"{SystemClock().utc_now():%Y-%m-%d}"
    numbered = [line_name(number) for number in range(1, len(site.lines()) + 1)]
    assert [version.name for version in versions] == [*numbered, f"{ROOTS}{today}"]
    earliest = SystemClock().utc_now() + timedelta(days=LOCKED_DAYS, minutes=-5)
    for version in versions:
        read = site.locked.read(version)
        assert read is not None
        assert read.retained_until is not None
        assert read.retained_until > earliest
        deleted = site.objects.requests.send("DELETE", site.key(version.name), query={"versionId": version.version})
        assert deleted.status == 403
    report = verify(site.data)
    assert report.ok, report.first_fault
    assert report.verified
    assert report.anchors is not None
    assert (report.anchors.lines, report.anchors.roots, report.anchors.heads) == (len(site.lines()), 1, 3)
    assert site.anchor() == 0, "another process finds that nothing is missing"
    said = CliRunner().invoke(app, ["audit", "verify", "all", "--data", str(site.data)])
    assert said.exit_code == 0, said.output
    assert f"{len(site.lines())} anchored signatures" in " ".join(said.output.split())


def test_signatures_are_anchored_later_and_beside_files_after_the_store_was_away(site: Site) -> None:
    site.sign_another_run()
    waiting = verify(site.data)
    assert waiting.ok, waiting.first_fault
    assert any("no anchor in the object store yet" in note for note in waiting.notes)
    site.section(anchor_within_hours=0)
    assert "has no anchor in the object store" in site.faults(), "older than the stated patience"
    site.section(anchor_within_hours=24)
    with Store.open(site.data) as store:
        Uploader(store, site.objects, AnchorWriter(store, site.locked, LOCKED_DAYS)).drain()
    report = verify(site.data)
    assert report.anchors is not None
    assert report.anchors.lines == len(site.lines())
    assert not any("no anchor" in note for note in report.notes)


def test_with_the_store_away_it_is_counted_and_never_called_verified(site: Site) -> None:
    site.section(endpoint="http://127.0.0.1:9")  # nobody listens there
    report = verify(site.data)
    assert report.ok, report.first_fault
    assert not report.verified
    assert report.anchors is not None
    assert (report.anchors.lines_not_compared, report.anchors.heads_not_compared) == (len(site.lines()), 3)
    assert report.not_compared[0] in report.notes
    assert "does not answer" in report.not_compared[0]
    run_id = report.runs[0]
    shown = verification_of(report, run_id, by="Ada", at_utc="2026-11-28T12:00:00.000000Z", duration_s=1.0)
    assert verified(shown, report.heads[run_id]) == "partial"
    assert list(shown.limits) == list(report.not_compared), "the page says it in the open"
    said = CliRunner().invoke(app, ["audit", "verify", "all", "--data", str(site.data)])
    assert said.exit_code == 1
    assert "NOT verified as a whole" in said.output
    assert "Verified:" not in said.output


def rolled_back(site: Site, before: Path) -> None:
    """Put the whole data folder back to an older copy: database, log of signatures and journal."""
    shutil.rmtree(site.data)
    shutil.copytree(before, site.data)


def roll_back(site: Site) -> None:
    before = site.data.with_name("before")
    copy_data(site.data, before)
    site.sign_another_run()
    site.anchor()
    rolled_back(site, before)
    assert not _without_anchors(site).faults, "nothing here shows it"


def _without_anchors(site: Site) -> AuditReport:
    text = (site.data / "site.yaml").read_text()
    site.section(lock_days=None)
    report = verify(site.data)
    (site.data / "site.yaml").write_text(text)
    return report


def roll_back_and_go_on(site: Site) -> None:
    roll_back(site)
    while len(site.lines()) < 12:
        site.sign_another_run()


def mark_as_deleted(site: Site) -> None:
    assert site.objects.requests.send("DELETE", site.key(line_name(2))).status == 204
    assert site.objects.requests.send("GET", site.key(line_name(2))).status == 404


def roll_back_and_mark_as_deleted(site: Site) -> None:
    roll_back(site)
    for listed in list(site.locked.versions("anchors/")):
        site.objects.requests.send("DELETE", site.key(listed.name))


def overwrite(site: Site) -> None:
    assert site.objects.requests.send("PUT", site.key(line_name(2)), body=b"another line").status == 200


def overwrite_the_root(site: Site) -> None:
    name = f"{ROOTS}{SystemClock().utc_now():%Y-%m-%d}"
    assert site.objects.requests.send("PUT", site.key(name), body=b"{}").status == 200


def line_anchor(line: bytes, until: datetime) -> bytes:
    return LineAnchor(line.decode(), utc_text(until)).content()


def put_without_a_lock(site: Site) -> None:
    site.sign_another_run()
    number = len(site.lines())
    content = line_anchor(site.lines()[-1], SystemClock().utc_now() + timedelta(days=LOCKED_DAYS))
    assert site.objects.requests.send("PUT", site.key(line_name(number)), body=content).status == 200
    site.anchor()


def put_for_too_short(site: Site) -> None:
    site.sign_another_run()
    soon = SystemClock().utc_now() + timedelta(minutes=5)
    content = line_anchor(site.lines()[-1], SystemClock().utc_now() + timedelta(days=LOCKED_DAYS))
    assert site.locked.store(line_name(len(site.lines())), content, soon)
    site.anchor()


def put_a_strangers_anchor(site: Site) -> None:
    line = json.loads(site.lines()[-1])
    line["number"] += 1
    until = SystemClock().utc_now() + timedelta(days=1)
    forged = json.dumps(line, separators=(",", ":")).encode()
    assert site.locked.store(line_name(line["number"]), line_anchor(forged, until), until)


def put_a_strangers_root(site: Site) -> None:
    until = SystemClock().utc_now() + timedelta(days=1)
    forged = RootAnchor("2020-01-01", "2020-01-01T00:00:00.000000Z", utc_text(until), merkle_root(()), ())
    assert site.locked.store(f"{ROOTS}2020-01-01", forged.content(), until)


def put_a_strangers_object(site: Site) -> None:
    assert site.objects.requests.send("PUT", site.key("anchors/notes.txt"), body=b"hello").status == 200


def alter_a_line(site: Site) -> None:
    lines = site.lines()
    lines[1] = lines[1].replace(b'"number":2', b'"number":3')
    (site.data / LOG).write_bytes(b"\n".join(lines) + b"\n")


FORGERIES: dict[Callable[[Site], None], list[str]] = {
    roll_back: ["holds anchors up to line"],
    roll_back_and_go_on: ["it is not the line that anchors/lines/"],
    roll_back_and_mark_as_deleted: ["holds anchors up to line"],
    overwrite: ["anchors/lines/000000000002 in", "it was overwritten: 1 later version with other content"],
    overwrite_the_root: ["anchors/roots/", "it was overwritten"],
    put_without_a_lock: ["it is not locked"],
    put_for_too_short: ["it is locked until"],
    put_a_strangers_anchor: ["no key of this record signed it: somebody else put it"],
    put_a_strangers_root: ["anchors/roots/2020-01-01", "no key of this record signed it"],
    put_a_strangers_object: ["anchors/notes.txt", "this is no anchor that this software writes"],
    alter_a_line: ["line 2: it is not the line that anchors/lines/000000000002"],
}


@pytest.mark.parametrize("forge", FORGERIES, ids=lambda forge: forge.__name__.replace("_", " "))
def test_a_forgery_is_found(site: Site, forge: Callable[[Site], None]) -> None:
    forge(site)
    found = site.faults()
    for sentence in FORGERIES[forge]:
        assert sentence in found


def test_a_run_that_was_rolled_back_is_named_by_the_root_of_the_day(site: Site) -> None:
    """The log and the site's chain are as they were: only the ends that the root names show it."""
    report = verify(site.data)
    run_id = report.runs[0]
    tamper(
        site.data,
        f"UPDATE events SET sha256 = '{'0' * 64}' WHERE run_id = '{run_id}' AND seq = "
        f"(SELECT max(seq) FROM events WHERE run_id = '{run_id}')",
    )
    assert "names this as its last event" in site.faults()


def test_a_mark_of_deletion_hides_nothing_and_is_noted(site: Site) -> None:
    mark_as_deleted(site)
    report = verify(site.data)
    assert report.ok, report.first_fault
    assert report.anchors is not None
    assert report.anchors.lines == len(site.lines())
    assert any("marked 1 anchor as deleted (anchors/lines/000000000002)" in note for note in report.notes)
    assert site.anchor() == 0, "it is not written again"


def test_who_takes_the_lock_out_of_the_site_file_is_found_with_a_copy_of_it(site: Site, tmp_path: Path) -> None:
    elsewhere = tmp_path / "auditor"
    elsewhere.mkdir()
    for name in ("site.yaml", "store_keys.yaml"):
        shutil.copy2(site.data / name, elsewhere / name)
    roll_back(site)
    site.section(lock_days=None)
    assert verify(site.data).ok
    arguments = ["audit", "verify", "all", "--json", "--data", str(site.data)]
    said = CliRunner().invoke(app, [*arguments, "--anchors", str(elsewhere / "site.yaml")])
    assert said.exit_code == 1
    assert "holds anchors up to line" in json.loads(said.output)["first_fault"]["text"]


def test_days_without_a_root_are_counted(site: Site) -> None:
    today = SystemClock().utc_now()
    with Store.open(site.data) as store:
        writer = AnchorWriter(store, site.locked, LOCKED_DAYS)
        day = f"{today - timedelta(days=4):%Y-%m-%d}"
        until = (today + timedelta(days=1)).replace(microsecond=0)
        content = writer.root(day, utc_text(today), utc_text(until)).content()
        assert site.locked.store(f"{ROOTS}{day}", content, until)
    report = verify(site.data)
    assert report.ok, report.first_fault
    first = f"{today - timedelta(days=3):%Y-%m-%d}"
    assert any(f"longest time without is 3 days from {first} on" in note for note in report.notes)


def test_a_line_that_is_older_than_the_lock_needs_no_anchor(site: Site) -> None:
    site.sign_another_run()
    anchors, lines = read_anchors(site.data), read_log(site.data / LOG)
    assert isinstance(anchors, ReadAnchors)
    assert lines is not None
    later = replace(anchors, at=anchors.at + timedelta(days=LOCKED_DAYS, hours=1), patience=timedelta())
    record = RecordSide(lines, {}, {}, every_run=False)
    assert any("no anchor any more, up to line" in note for note in compare(later, record).notes)

    def unanchored(at: datetime) -> bool:
        return any("has no anchor" in fault.what for fault in compare(replace(later, at=at), record).faults)

    assert not unanchored(later.at)
    assert unanchored(anchors.at + timedelta(hours=1))
    assert not unanchored(anchors.at - timedelta(hours=1)), "it was signed after the anchors were read"


def test_a_bucket_without_lock_is_refused_and_keeps_no_file_waiting(weed: Weed, tmp_path: Path) -> None:
    objects = weed.write_site(tmp_path / "data")
    site = Site(tmp_path / "data", objects, weed)
    site.sign_another_run()
    with Store.open(site.data) as store:
        uploader = Uploader(store, objects, AnchorWriter(store, site.locked, LOCKED_DAYS))
        with pytest.raises(ObjectStoreError, match="made without object lock"):
            uploader.drain()


def test_an_uploader_says_at_once_that_the_log_was_rolled_back(site: Site) -> None:
    roll_back(site)
    said = CliRunner().invoke(app, ["store", "upload", "--data", str(site.data)])
    assert said.exit_code == 1
    assert "that the log of signatures does not have" in " ".join(said.output.split())


@pytest.mark.slow
@pytest.mark.packages("postgresql")
@pytest.mark.sqlite("shares the database of a server by itself")
def test_a_folder_that_does_not_sign_compares_the_ends_of_chains_and_says_what_it_cannot(
    weed: Weed, bucket: str, tmp_path: Path
) -> None:
    """Two folders share a site's database and object store; the log of signatures is in the first."""
    cluster = Cluster(brief=True)
    cluster.start()
    try:
        first, second = tmp_path / "first", tmp_path / "second"
        objects = weed.write_site(first, bucket=bucket, lock_days=LOCKED_DAYS)
        site = Site(first, objects, weed)
        database = cluster.new_database()
        of_site = yaml.safe_load((first / "site.yaml").read_text()) | {"database": cluster.address(database)}
        (first / "site.yaml").write_text(yaml.safe_dump(of_site))
        run_id = site.sign_another_run()
        site.anchor()
        second.mkdir(mode=0o700)
        for name in ("site.yaml", "store_keys.yaml"):
            shutil.copy(first / name, second)
        shutil.copytree(first / "artefacts", second / "artefacts")
        report = verify(second)
        assert report.ok, report.faults
        assert not report.verified, "the log's lines were compared with nothing"
        assert report.anchors is not None
        assert (report.anchors.lines, report.anchors.roots, report.anchors.heads) == (0, 1, 2)
        assert report.anchors.lines_not_compared == len(site.lines())
        assert f"the log of signatures is in {first} on " in report.not_compared[0]
        away = Site(second, objects, weed)
        reached = yaml.safe_load((second / "site.yaml").read_text())["object_store"]["endpoint"]
        away.section(endpoint="http://127.0.0.1:9")
        counts = verify(second).anchors
        assert counts is not None
        assert (counts.lines_not_compared, counts.heads_not_compared) == (len(site.lines()), 2)
        away.section(endpoint=reached)
        cluster.run(
            database,
            "ALTER TABLE events DISABLE TRIGGER ALL",
            f"UPDATE events SET sha256 = reverse(sha256) WHERE run_id = '{run_id}'",
            "ALTER TABLE events ENABLE TRIGGER ALL",
        )
        faults = verify(second).faults
        assert any(fault.run_id == run_id and "the root of" in fault.what for fault in faults), faults
    finally:
        cluster.stop()
