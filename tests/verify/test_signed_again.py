"""A record that somebody without a key rewrote, and that was then signed again: what still shows it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from service.audit import bundle_verifier
from service.audit.bundle import export_bundle
from service.core.errors import IntegrityError
from service.store.records import SITE
from service.store.signatures.log import NAME
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.outsider import INDEX_AGAIN, rows, tamper
from tests.support.record.tampering import cut, journal_anew, rewrite_to_the_end, without_signatures_from
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store

UNSIGNED = PROTOCOL.replace(
    "    irreversible: true\n    sign: true\n", ""
)  # a person's signature of a step holds the hash of the record
COUNTED_AGAIN = (
    "UPDATE event_index SET position = position + 100000",
    "UPDATE event_index SET position = (SELECT count(*) FROM event_index AS i "
    "WHERE i.position <= event_index.position)",
)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A signed run, and a completed one after it."""
    folder = tmp_path / "data"
    with bench_store(folder) as store:
        checkpoint(store, begin_run(store, PROTOCOL, tmp_path).run_id)
        assert begin_run(store, UNSIGNED, tmp_path).run().status == "completed"
    return folder


def completed(data: Path) -> str:
    with Store.open(data) as store:
        return store.runs()[-1].run_id


def forge(data: Path, run: str) -> list[int]:
    """Rewrite the run from its first capture on, and cut the site's chain and the log to before its first signature.

    Returns the passed steps, which lost the signatures of their own.
    """
    passed = [int(str(seq)) for (seq,) in rows(data, f"SELECT seq FROM checkpoints WHERE run_id = '{run}'")]
    captures = f"SELECT min(seq) FROM events WHERE kind = 'viewpoint_captured' AND run_id = '{run}'"
    ((captured,),) = rows(data, captures)
    signings = rows(data, "SELECT seq, payload FROM events WHERE kind = 'run_signed' ORDER BY seq")
    site_seq = next(seq for seq, payload in signings if json.loads(str(payload))["run"] == run)
    rewrite_to_the_end(data, run, int(str(captured)), actor="Eve")
    tamper(
        data,
        f"UPDATE event_index SET actor = 'Eve' WHERE run_id = '{run}' AND seq = {captured}",
        *without_signatures_from(run, 1),
        *cut(SITE, int(str(site_seq))),
        *COUNTED_AGAIN,
        *INDEX_AGAIN,
    )
    lines = (data / NAME).read_bytes().splitlines(keepends=True)
    first = next(at for at, line in enumerate(lines) if json.loads(line)["checkpoint"]["run_id"] == run)
    (data / NAME).write_bytes(b"".join(lines[:first]))
    journal_anew(data)
    return passed[:-1]  # the last of them is the run's end


def test_what_was_signed_at_once_and_is_signed_only_later_stays_told(data: Path, tmp_path: Path) -> None:
    run = completed(data)
    assert (verify(data).faults, verify(data).notes) == ((), ())
    passed = forge(data, run)
    assert len(passed) == 3
    faults = [str(fault) for fault in verify(data).faults]
    assert faults == [f"run {run}, event {seq}: step passed was never signed, or its signature was removed"
                      for seq in passed]  # fmt: skip
    with Store.open(data) as store:
        with pytest.raises(IntegrityError, match="nothing is exported, because the evidence does not verify"):
            export_bundle(store, run, tmp_path / "bundle.zip", actor="ada")
        signed = checkpoint(store, run)  # as a person does who resumes the run
        events = ", ".join(map(str, passed))
        assert verify(data).faults == ()
        assert verify(data).notes == (
            f"{run}: events {events}, signed at once as a rule, were signed only with event {signed.seq}: "
            "a change before that leaves no trace",
        )
        bundle = export_bundle(store, run, tmp_path / "bundle.zip", actor="ada").path
    check = bundle_verifier.Check()
    check.run(bundle, None, None)
    assert check.faults == []
    assert (
        f"{run}: not signed at once, but only with a later event: {events}; a change before that leaves no trace."
        in (check.notes)
    )
