"""What this process has seen of the signatures: each signature looks only at what is new since the one before.

So the cost of a signature does not grow with the age of a site. The first look of a process reads everything.
"""

from __future__ import annotations

from threading import Lock

from sqlalchemy import Connection, literal_column, select

from service.store.database.tables import checkpoints, events
from service.store.events import parse_canonical
from service.store.records import SITE, Checkpoint
from service.store.signatures.checkpoints import read_checkpoint, to_checkpoint
from service.store.signatures.log import NAME, LogEnd, LogLine, SignatureLog, power_cut_explains
from service.store.verification.chain_checks import Fault

_ROWID = literal_column("checkpoints.rowid").label("place")  # no row is ever removed, so it counts them
_NEW = (
    select(checkpoints, events.c.sha256.label("signed_sha256"), _ROWID)
    .outerjoin_from(
        checkpoints, events, (events.c.run_id == checkpoints.c.run_id) & (events.c.seq == checkpoints.c.seq)
    )
    .order_by(_ROWID)
)
_SIGNATURE = select(checkpoints.c.signature)
_KEYS = select(events.c.seq, events.c.payload).where(events.c.run_id == SITE, events.c.kind == "key_changed")
_HEAD = select(events.c.seq).where(events.c.run_id == SITE).order_by(events.c.seq.desc()).limit(1)


class SeenSignatures:
    """The checkpoints and the log of one data folder, compared as far as this process has seen them.

    What was compared is not read again, but the last line and the last checkpoint must still be there; if they are
    not, everything is read again.

    Attributes:
        there: whether there is a log.
        end: where the log ends, as far as it was read.
        missing: checkpoints without a line, oldest first.
        explained: whether an interrupted signature explains the missing lines.
        key_id: fingerprint of the key in use; "" before the first signature.
    """

    def __init__(self, log: SignatureLog) -> None:
        self._log = log
        self._one_look = Lock()
        self.forget()

    def forget(self) -> None:
        """Read everything again at the next look."""
        self.there = False
        self.end = LogEnd()
        self.missing: tuple[Checkpoint, ...] = ()
        self.explained = True
        self.key_id = ""
        self._last = (0, "")  # place and signature of the last checkpoint
        self._newest = 0  # the newest site_seq that has a line
        self._keys_until = 0  # event of the site's chain up to which changes of the key were looked for
        self._of_log: Fault | None = None
        self._of_run: dict[str, Fault] = {}

    def look(self, connection: Connection) -> None:
        """Read what is new in the log and among the checkpoints. Raises StoreError if the log cannot be read."""
        with self._one_look:
            read = self._log.lines_after(self.end) if self._still_there(connection) else None
            if read is None:
                self.forget()
                read = self._log.lines_after(self.end)
            # The log was read before the rows: a signature is a row before it is a line.
            self._read_rows(connection)
            self.there = read is not None
            if read is not None:
                lines, self.end = read
                self._compare(connection, lines)
            self.explained = power_cut_explains(self.missing, self._newest)
            self.key_id, self._keys_until = self.key_in_use(connection), connection.execute(_HEAD).scalar() or 0

    def made_since(self, connection: Connection) -> list[Checkpoint]:
        """The checkpoints that were made since the last look, oldest first."""
        return [to_checkpoint(row) for row in connection.execute(_NEW.where(self._last[0] < _ROWID))]

    def fault(self, run_id: str) -> Fault | None:
        """What forbids to sign this chain: its signatures, or the log; None if nothing does."""
        if not self.there and self.key_id:
            return Fault(None, None, NAME, "the log of signatures is missing: it was removed")
        return self._of_run.get(run_id) or self._of_log

    def _still_there(self, connection: Connection) -> bool:
        place, signature = self._last
        if not place:
            return True
        return connection.execute(_SIGNATURE.where(place == _ROWID)).scalar() == signature

    def _read_rows(self, connection: Connection) -> None:
        missing = list(self.missing)
        for row in connection.execute(_NEW.where(self._last[0] < _ROWID)):
            item = to_checkpoint(row)
            missing.append(item)
            self._last = row.place, item.signature
            if row.signed_sha256 != item.sha256:
                what = "a signature is for another event than the one that is here"
                self._of_run.setdefault(item.run_id, Fault(item.run_id, item.seq, "", what))
        self.missing = tuple(missing)

    def _compare(self, connection: Connection, lines: list[LogLine]) -> None:
        awaited = {(item.run_id, item.seq): item for item in self.missing}
        for line in lines:
            said = line.checkpoint
            if said is None or line.problem:
                self._of_log = self._of_log or Fault(None, None, f"{NAME}, line {line.number}", line.problem)
                continue
            here = awaited.pop((said.run_id, said.seq), None) or read_checkpoint(connection, said.run_id, said.seq)
            self._newest = max(self._newest, said.site_seq)
            if here != said:
                what = f"{NAME} holds another signature of this event, or one more"
                self._of_run.setdefault(said.run_id, Fault(said.run_id, said.seq, "", what))
        self.missing = tuple(awaited.values())

    def key_in_use(self, connection: Connection) -> str:
        """Fingerprint of the key in use; "" before the first signature."""
        found = self.key_id
        for row in connection.execute(_KEYS.where(events.c.seq > self._keys_until).order_by(events.c.seq)):
            try:
                found = str(parse_canonical(row.payload)["key_id"])
            except (ValueError, TypeError, LookupError):
                self._of_log = Fault(SITE, row.seq, "", "the change of the key cannot be read")
        return found
