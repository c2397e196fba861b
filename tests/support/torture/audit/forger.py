"""A forger who rewrites a run from some event on, makes every hash fit, and signs with the available keys."""

from __future__ import annotations

import base64
import hashlib
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from itertools import product
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from service.store.artefacts import record_sha256
from service.store.database.engine import database_path
from service.store.durable_effects import DurableFiles
from service.store.events import ROOT, canonical, event_sha256, parse_canonical
from service.store.journal import FIRST, Journal, JournalLine, LineFields, every_row, line_bytes, read_lines
from service.store.records import SITE, Checkpoint
from service.store.signatures.checkpoints import RowsDigest, key_fingerprint, public_bytes
from service.store.signatures.checkpoints import statement as signed_text
from service.store.signatures.log import NAME, LogEnd, SignatureLog
from tests.support.record.outsider import INDEX_AGAIN, know_index
from tests.support.torture.audit import outcome
from tests.support.torture.audit.outcome import Verdict, verdict
from tests.support.torture.audit.record import Record, put_back
from tests.support.torture.audit.tally import Tallies, Tally

CAN_WRITE = ("database", "site's chain", "journal", "log", "second place")
KEYS = ("no key", "a key of his own", "the key in use", "every key")
_EVENT = ("seq", "run_id", "at_utc", "monotonic_s", "actor", "previous_sha256")
_CHECKPOINT = tuple(Checkpoint.__dataclass_fields__)


class Forgeries:
    """Numbered forgeries: every event of every run × every subset of what can be written × every set of keys."""

    name = "forgery"

    def __init__(self, record: Record) -> None:
        put_back(record)
        self._record = record
        whole = outcome.audit.verify(record.data, signatures_copy=record.copy)
        self._notes, self._heads, self._key_ids = whole.notes, whole.heads, whole.key_ids
        with closing(sqlite3.connect(database_path(record.data))) as connection:
            places = connection.execute("SELECT run_id, seq FROM events WHERE run_id <> 'site'").fetchall()
            self._last = dict(
                connection.execute("SELECT run_id, max(seq) FROM checkpoints GROUP BY run_id").fetchall()
            )
        self._stamped = _checkpoints(record, stamped=True)
        powers = [
            (frozenset(name for name, can in zip(CAN_WRITE, some, strict=True) if can), keys)
            for some in product((True, False), repeat=len(CAN_WRITE))
            for keys in KEYS
        ]
        # Without the database the site's chain cannot be written either; without any power nothing happens.
        powers = [(can, keys) for can, keys in powers if can and ("database" in can or "site's chain" not in can)]
        self.all = [(run_id, seq, can, keys) for run_id, seq in places for can, keys in powers]
        self.size = len(self.all)

    def part(self, numbers: Sequence[int]) -> Tallies:
        """Make these forgeries one at a time; returns tallies by keys, and by whether the signature copy is compared.

        For undetected forgeries it is checked whether something kept elsewhere reveals them: the copy of the log, the
        time stamp, the fingerprints of the keys, or the hashes of the chain ends.
        """
        tallies: Tallies = {}
        for number in numbers:
            run_id, seq, can, keys = self.all[number]
            put_back(self._record)
            _Forger(self._record, can, keys).forge(run_id, seq)
            tail = seq > self._last.get(run_id, 0) and "journal" in can
            for with_copy in (False, True):
                compared = "second place compared" if with_copy else "second place not looked at"
                tally = tallies.setdefault(f"forger with {keys}, {compared}", Tally())
                found = verdict(self._record, self._notes, with_copy=with_copy)
                code = "commits after the last signature" if tail else self._code(can, keys, with_copy=with_copy)
                changed = found.heads != self._heads or found.key_ids != self._key_ids
                name = f"{run_id} from event {seq}, can write {', '.join(sorted(can))}"
                tally.count(found, name, lambda code=code, changed=changed: {code} if changed else set())
                if changed and not found.told:
                    tally.anchors.update(self._anchors(found))
        put_back(self._record)
        return tallies

    def _anchors(self, found: Verdict) -> Iterator[str]:
        assert found.heads is not None
        if any(found.heads.get(run_id) != head for run_id, head in self._heads.items()):
            yield "the ends of the chains written down"
        if found.key_ids != self._key_ids:
            yield "the fingerprints of the keys written down"
        if not set(self._stamped) <= set(_checkpoints(self._record)):
            yield "the time stamp of the first run"
        log = self._record.states[-1].log
        if log is not None and not (self._record.data / NAME).read_bytes().startswith(log):
            yield "a copy of the log of signatures that he cannot write"

    @staticmethod
    def _code(can: frozenset[str], keys: str, *, with_copy: bool) -> str:
        places = {"log", "site's chain", "journal"} | ({"second place"} if with_copy else set())
        code = f"forger: {keys}" + (", second place too" if with_copy and places <= can else "")
        return code if "journal" in can else f"{code}, without the journal"


class _Forger:
    def __init__(self, record: Record, can: frozenset[str], keys: str) -> None:
        self._record = record
        self._can = can
        self._own = Ed25519PrivateKey.generate() if keys == "a key of his own" else None
        known = {"the key in use": record.keys[-1:], "every key": record.keys}.get(keys, ())
        self._keys: dict[str, Ed25519PrivateKey] = {}
        for pem in known:
            key = load_pem_private_key(pem, password=None)
            assert isinstance(key, Ed25519PrivateKey)
            self._keys[key_fingerprint(public_bytes(key))] = key
        self._renamed: dict[str, str] = {}  # event hashes: before → after

    def forge(self, run_id: str, seq: int) -> None:
        """Make the best possible forgery that changes this event."""
        if "database" in self._can:
            with closing(sqlite3.connect(database_path(self._record.data), isolation_level=None)) as connection:
                connection.row_factory = sqlite3.Row
                self._in_database(connection, run_id, seq)
        if "journal" in self._can:
            self._in_journal(run_id, seq)
        if "log" in self._can:
            self._in_log(run_id, seq)
        if "second place" in self._can:
            for name, path, copy in (
                ("log", self._record.data / NAME, self._record.copy),
                ("journal", self._record.journal, self._record.journal_copy),
            ):
                copy.write_bytes(path.read_bytes() if name in self._can else b"")

    # --- database ---

    def _in_database(self, connection: sqlite3.Connection, run_id: str, seq: int) -> None:
        know_index(connection)
        triggers = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
        connection.execute("BEGIN")
        for name, _sql in triggers:
            connection.execute(f'DROP TRIGGER "{name}"')
        if self._own is not None and "site's chain" in self._can:
            self._keys = self._new_keys(connection, self._own)
        self._rewrite(connection, run_id, seq, {seq: lambda fields: fields | {"actor": "Eve"}})
        connection.execute("DELETE FROM timestamps WHERE run_id = ? AND seq >= ?", (run_id, seq))
        self._sign_again(connection, run_id, seq)
        if "site's chain" in self._can:
            self._rewrite_site(connection, run_id, seq)
        for statement in INDEX_AGAIN:
            connection.execute(statement)
        for _name, sql in triggers:
            connection.execute(sql)
        connection.execute("COMMIT")

    def _rewrite(self, connection: sqlite3.Connection, run_id: str, seq: int, changes: Mapping[int, Any]) -> None:
        """Rewrite the events from `seq` on, with changed fields and matching hashes, and all dependent rows."""
        asked = "SELECT * FROM events WHERE run_id = ? ORDER BY seq"
        previous = ROOT
        for row in connection.execute(asked, (run_id,)).fetchall():
            if row["seq"] < seq:
                previous = row["sha256"]
                continue
            text = row["payload"]
            for before, after in self._renamed.items():  # signatures and exports refer to events by hash
                text = text.replace(before, after)
            fields = {name: row[name] for name in _EVENT} | {"payload": parse_canonical(text)}
            fields = changes.get(row["seq"], dict)(fields) | {"previous_sha256": previous}
            previous = event_sha256(fields)
            self._renamed[row["sha256"]] = previous
            where = (run_id, row["seq"])
            connection.execute(
                "UPDATE events SET kind = ?, actor = ?, payload = ?, previous_sha256 = ?, sha256 = ? "
                "WHERE run_id = ? AND seq = ?",
                (
                    fields["payload"]["kind"],
                    fields["actor"],
                    canonical(fields["payload"]),
                    fields["previous_sha256"],
                    previous,
                    *where,
                ),
            )
            connection.execute(
                "UPDATE event_index SET actor = ?, kind = ? WHERE run_id = ? AND seq = ?",
                (fields["actor"], fields["payload"]["kind"], *where),
            )
            for artefact in connection.execute(
                "SELECT * FROM artefacts WHERE run_id = ? AND seq = ?", where
            ).fetchall():
                digest = record_sha256(previous, dict(artefact))
                place = (digest, *where, artefact["position"])
                connection.execute(
                    "UPDATE artefacts SET record_sha256 = ? WHERE run_id = ? AND seq = ? AND position = ?", place
                )
        connection.execute("UPDATE heads SET sha256 = ? WHERE run_id = ?", (previous, run_id))
        if seq == 1:
            first = "(SELECT sha256 FROM events WHERE run_id = runs.run_id AND seq = 1)"
            connection.execute(f"UPDATE runs SET root_sha256 = {first} WHERE run_id = ?", (run_id,))

    def _rewrite_site(self, connection: sqlite3.Connection, run_id: str, seq: int) -> None:
        """Rewrite the site's chain about the run and its stamps, with the forger's keys in place of the others."""
        changes: dict[int, Any] = {}
        first: int | None = None
        new = self._keys if self._own is not None else {}
        for row in connection.execute(
            "SELECT seq, payload FROM events WHERE run_id = 'site' ORDER BY seq"
        ).fetchall():
            payload = parse_canonical(row["payload"])
            after = dict(payload)
            if payload["kind"] == "key_changed" and new:
                raw = public_bytes(new[payload["key_id"]])
                after |= {"key_id": key_fingerprint(raw), "public_key": base64.b64encode(raw).decode()}
                before = new.get(payload["previous_key_id"])
                after |= {"previous_key_id": "" if before is None else key_fingerprint(public_bytes(before))}
            elif payload["kind"] == "time_stamp_kept" and payload["run"] == run_id and payload["seq"] >= seq:
                sha256 = self._sha256(connection, run_id, payload["seq"])
                after = {"kind": "run_signed", "run": run_id, "seq": payload["seq"], "sha256": sha256}
            elif any(before in row["payload"] for before in self._renamed):
                first = first or row["seq"]
            if after != payload:
                changes[row["seq"]] = lambda fields, after=after: fields | {"payload": after}
                first = first or row["seq"]
        if first is None:
            return
        self._rewrite(connection, SITE, first, changes)
        self._sign_again(connection, SITE, first)
        for other in connection.execute("SELECT DISTINCT run_id FROM checkpoints WHERE run_id <> 'site'").fetchall():
            self._sign_again(connection, other[0], 1, after_site=first)

    @staticmethod
    def _new_keys(connection: sqlite3.Connection, own: Ed25519PrivateKey) -> dict[str, Ed25519PrivateKey]:
        """For each key of the record the key that replaces it, by their fingerprints."""
        asked = "SELECT json_extract(payload, '$.key_id') FROM events WHERE kind = 'key_changed' ORDER BY seq"
        known = [str(row[0]) for row in connection.execute(asked).fetchall()]
        keys = [own, *(Ed25519PrivateKey.generate() for _ in known[1:])]
        his = {key_fingerprint(public_bytes(key)): key for key in keys}
        return dict(zip(known, keys, strict=True)) | his

    @staticmethod
    def _sha256(connection: sqlite3.Connection, run_id: str, seq: int) -> str:
        asked = "SELECT sha256 FROM events WHERE run_id = ? AND seq = ?"
        return str(connection.execute(asked, (run_id, seq)).fetchone()[0])

    def _sign_again(self, connection: sqlite3.Connection, run_id: str, seq: int, *, after_site: int = 0) -> None:
        """Make the signatures that no longer fit again where the key is available, and delete the others."""
        asked = f"SELECT {', '.join(_CHECKPOINT)} FROM checkpoints WHERE run_id = ? AND seq >= ? AND site_seq >= ?"
        for row in connection.execute(asked, (run_id, seq, after_site)).fetchall():
            where = (run_id, row["seq"])
            before = Checkpoint(**dict(row))
            key = self._keys.get(before.key_id)
            if key is None:
                connection.execute("DELETE FROM timestamps WHERE run_id = ? AND seq = ?", where)
                connection.execute("DELETE FROM checkpoints WHERE run_id = ? AND seq = ?", where)
                continue
            digest = RowsDigest()
            rows = "SELECT record_sha256 FROM artefacts WHERE run_id = ? AND seq <= ? ORDER BY seq, position"
            for (record,) in connection.execute(rows, where).fetchall():
                digest.add(record)
            made = replace(
                before,
                sha256=self._sha256(connection, *where),
                artefacts_sha256=digest.hexdigest(),
                site_sha256=self._sha256(connection, SITE, before.site_seq),
                key_id=key_fingerprint(public_bytes(key)),
            )
            signed = replace(made, signature=base64.b64encode(key.sign(signed_text(made))).decode())
            values = asdict(signed)
            columns = ", ".join(f"{name} = ?" for name in values)
            connection.execute(
                f"UPDATE checkpoints SET {columns} WHERE run_id = ? AND seq = ?", (*values.values(), *where)
            )

    # --- journal ---

    def _in_journal(self, run_id: str, seq: int) -> None:
        """Make a journal that fits the forged database; without the database, change the event in the journal."""
        journal = self._record.journal
        if "database" in self._can:
            with closing(sqlite3.connect(database_path(self._record.data), isolation_level=None)) as connection:
                tail = Journal(self._record.data, DurableFiles()).begin(every_row(connection), 0)
                connection.execute(f"PRAGMA user_version = {tail.number}")
            return
        previous, content = FIRST, b""
        for line in read_lines(journal):
            if isinstance(line, JournalLine):
                place = "events", run_id, seq
                rows = [
                    replace(row, values={**row.values, "actor": "Eve"})
                    if (row.table, row.values.get("run_id"), row.values.get("seq")) == place
                    else row
                    for row in line.rows
                ]
                fields = LineFields(line.number, line.after, previous, line.continued, line.earlier_events)
                raw = line_bytes(fields, rows)
                previous, content = hashlib.sha256(raw).hexdigest(), content + raw
        journal.write_bytes(content)

    # --- log of signatures ---

    def _in_log(self, run_id: str, seq: int) -> None:
        """Rewrite the log lines from the first that no longer fits where a key is available.

        Truncate the log otherwise.
        """
        path = self._record.data / NAME
        lines = path.read_bytes().splitlines(keepends=True)
        with closing(sqlite3.connect(f"file:{database_path(self._record.data)}?mode=ro", uri=True)) as connection:
            columns = ", ".join(_CHECKPOINT)
            made = [Checkpoint(*row) for row in connection.execute(f"SELECT {columns} FROM checkpoints").fetchall()]
        present = {(item.run_id, item.seq): item for item in made}
        kept = 0
        for line in lines:
            signed = parse_canonical(line.decode())["checkpoint"]
            item = present.get((signed["run_id"], signed["seq"]))
            if item is None or asdict(item) != signed:
                break
            if "database" not in self._can and (signed["run_id"], signed["seq"] >= seq) == (run_id, True):
                break
            kept += 1
        path.write_bytes(b"".join(lines[:kept]))
        keys = list(self._keys.values())
        if keys and "database" in self._can:
            order = [parse_canonical(line.decode())["checkpoint"] for line in lines]
            left = [present[place] for item in order if (place := (item["run_id"], item["seq"])) in present]
            log = SignatureLog(path.parent, DurableFiles(), patience_s=0.0)
            read = log.lines_after(LogEnd())
            assert read is not None
            whole, end = read
            held = {(one.checkpoint.run_id, one.checkpoint.seq) for one in whole if one.checkpoint is not None}
            log.add(end, [one for one in left if (one.run_id, one.seq) not in held], keys[-1])


def _checkpoints(record: Record, *, stamped: bool = False) -> list[tuple[Any, ...]]:
    """All current signatures, or those with a time stamp."""
    asked = f"SELECT {', '.join(_CHECKPOINT)} FROM checkpoints"
    if stamped:
        asked += " WHERE (run_id, seq) IN (SELECT run_id, seq FROM timestamps)"
    with closing(sqlite3.connect(f"file:{database_path(record.data)}?mode=ro", uri=True)) as connection:
        return connection.execute(asked).fetchall()
