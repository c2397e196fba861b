"""The tables for SQLAlchemy. The migrations create them; a test checks that the two agree."""

from __future__ import annotations

from sqlalchemy import (
    REAL,
    CheckConstraint,
    Column,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    Integer,
    MetaData,
    PrimaryKeyConstraint,
    Table,
    Text,
    UniqueConstraint,
)

metadata = MetaData()

runs = Table(
    "runs",
    metadata,
    Column("run_id", Text, primary_key=True),
    Column("created_utc", Text, nullable=False),
    Column("simulated", Integer, nullable=False),
    Column("root_sha256", Text, nullable=False),
    CheckConstraint("simulated IN (0, 1)", name="runs_simulated"),
    sqlite_strict=True,
)

events = Table(
    "events",
    metadata,
    Column("run_id", Text, ForeignKey("runs.run_id"), nullable=False),
    Column("seq", Integer, nullable=False),
    Column("kind", Text, nullable=False),
    Column("at_utc", Text, nullable=False),
    Column("monotonic_s", REAL, nullable=False),
    Column("actor", Text, nullable=False),
    Column("payload", Text, nullable=False),  # RFC 8785 canonical JSON
    Column("previous_sha256", Text, nullable=False),
    Column("sha256", Text, nullable=False),
    PrimaryKeyConstraint("run_id", "seq"),
    UniqueConstraint("run_id", "previous_sha256", name="events_no_fork"),
    CheckConstraint("seq >= 1", name="events_seq"),
    CheckConstraint("length(sha256) = 64 AND length(previous_sha256) = 64", name="events_hash_length"),
    sqlite_strict=True,
)

# The index by which auditors filter events, written with every event by the trigger events_indexed. There is also the
# full-text index `event_words` (FTS5, contentless, rowid = position), which SQLAlchemy cannot describe.
event_index = Table(
    "event_index",
    metadata,
    Column("position", Integer, primary_key=True),  # over all runs, in the order of writing
    Column("run_id", Text, nullable=False),
    Column("seq", Integer, nullable=False),
    Column("kind", Text, nullable=False),
    Column("step", Text),
    Column("device", Text),
    Column("actor", Text, nullable=False),
    UniqueConstraint("run_id", "seq", name="event_index_once"),
    Index("event_index_by_kind", "run_id", "kind", "seq"),
    sqlite_strict=True,
)

# The last event of each chain, written with every append, so that a truncated chain is found.
heads = Table(
    "heads",
    metadata,
    Column("run_id", Text, ForeignKey("runs.run_id"), primary_key=True),
    Column("seq", Integer, nullable=False),
    Column("sha256", Text, nullable=False),
    sqlite_strict=True,
)

artefacts = Table(
    "artefacts",
    metadata,
    Column("run_id", Text, nullable=False),
    Column("seq", Integer, nullable=False),  # of the event that brought it
    Column("position", Integer, nullable=False),  # 0, 1, 2 … within that event
    Column("sha256", Text, nullable=False),
    Column("kind", Text, nullable=False),
    Column("media_type", Text, nullable=False),
    Column("size_bytes", Integer, nullable=False),
    Column("original_name", Text, nullable=False),
    Column("device", Text, nullable=False),
    Column("step", Text),
    Column("attempt", Integer),
    Column("viewpoint", Text),
    Column("who", Text, nullable=False),
    Column("at_utc", Text, nullable=False),
    Column("monotonic_s", REAL, nullable=False),
    Column("record_sha256", Text, nullable=False),  # over all of the above and the event's sha256
    PrimaryKeyConstraint("run_id", "seq", "position"),
    ForeignKeyConstraint(["run_id", "seq"], ["events.run_id", "events.seq"]),
    CheckConstraint("length(sha256) = 64", name="artefacts_hash_length"),
    CheckConstraint("size_bytes >= 0", name="artefacts_size"),
    Index("artefacts_by_content", "sha256"),
    sqlite_strict=True,
)

jobs = Table(
    "jobs",
    metadata,
    Column("position", Integer, primary_key=True),  # order of claiming
    Column("job_id", Text, nullable=False, unique=True),
    Column("run_id", Text, nullable=False),
    Column("kind", Text, nullable=False),
    Column("step", Text, nullable=False),
    Column("attempt", Integer, nullable=False),  # of the step
    Column("idempotency_key", Text, nullable=False),
    Column("arguments", Text, nullable=False),  # RFC 8785 canonical JSON
    Column("state", Text, nullable=False),
    Column("tries", Integer, nullable=False),  # how often a worker has claimed it
    Column("try_limit", Integer, nullable=False),
    Column("enqueued_seq", Integer, nullable=False),
    Column("enqueued_utc", Text, nullable=False),
    Column("started_utc", Text),
    Column("ended_utc", Text),
    Column("ended_seq", Integer),
    Column("error", Text),
    Column("worker", Text),
    Column("token", Text),
    Column("until_utc_s", REAL),
    Column("host", Text),
    Column("boot", Text),
    Column("pid", Integer),
    Column("process_started_s", REAL),
    Column("priority", Integer, nullable=False, server_default="1"),  # smaller is claimed first
    ForeignKeyConstraint(["run_id", "enqueued_seq"], ["events.run_id", "events.seq"]),
    UniqueConstraint("run_id", "idempotency_key", name="jobs_idempotency"),
    CheckConstraint("state IN ('queued', 'running', 'finished', 'failed')", name="jobs_state"),
    Index("jobs_open", "state", "position"),
    sqlite_strict=True,
)

leases = Table(
    "leases",
    metadata,
    Column("run_id", Text, ForeignKey("runs.run_id"), primary_key=True),
    Column("holder", Text, nullable=False),
    Column("token", Text, nullable=False),
    Column("until_utc_s", REAL, nullable=False),
    Column("host", Text, nullable=False),
    Column("boot", Text, nullable=False),
    Column("pid", Integer, nullable=False),
    Column("process_started_s", REAL, nullable=False),
    sqlite_strict=True,
)

# Signatures over the chains; each covers every event up to its own.
checkpoints = Table(
    "checkpoints",
    metadata,
    Column("run_id", Text, nullable=False),
    Column("seq", Integer, nullable=False),  # of the last event that it covers
    Column("sha256", Text, nullable=False),  # of that event
    Column("artefacts_sha256", Text, nullable=False),  # over record_sha256 of the artefact rows up to it
    Column("site_seq", Integer, nullable=False),  # end of the site's chain, which tells the valid key
    Column("site_sha256", Text, nullable=False),
    Column("at_utc", Text, nullable=False),
    Column("key_id", Text, nullable=False),  # SHA-256 of the raw public key
    Column("signature", Text, nullable=False),  # base64, Ed25519 over service.store.signatures.checkpoints.statement
    PrimaryKeyConstraint("run_id", "seq"),
    ForeignKeyConstraint(["run_id", "seq"], ["events.run_id", "events.seq"]),
    sqlite_strict=True,
)

# Time stamps on checkpoints (RFC 3161).
timestamps = Table(
    "timestamps",
    metadata,
    Column("run_id", Text, nullable=False),
    Column("seq", Integer, nullable=False),  # of the checkpoint
    Column("authority", Text, nullable=False),
    Column("at_utc", Text, nullable=False),
    Column("token", Text, nullable=False),  # base64 of the DER TimeStampResp
    PrimaryKeyConstraint("run_id", "seq", "authority"),
    ForeignKeyConstraint(["run_id", "seq"], ["checkpoints.run_id", "checkpoints.seq"]),
    sqlite_strict=True,
)

# People. The rows are the present state; every change is recorded in the site's chain.
accounts = Table(
    "accounts",
    metadata,
    Column("account", Text, primary_key=True),  # the name to sign in with
    Column("full_name", Text, nullable=False),
    Column("role", Text, nullable=False),
    Column("state", Text, nullable=False),
    Column("password_hash", Text, nullable=False),  # argon2id; "" while invited
    Column("pin_hash", Text, nullable=False),  # argon2id; "" for none
    Column("failures", Integer, nullable=False),  # in a row
    Column("locked_until_utc_s", REAL, nullable=False),
    Column("created_utc", Text, nullable=False),
    Column("badge_hash", Text, nullable=False, server_default=""),  # argon2id; "" for none
    CheckConstraint("role IN ('technician', 'supervisor', 'auditor', 'administrator')", name="accounts_role"),
    CheckConstraint("state IN ('invited', 'active', 'disabled')", name="accounts_state"),
    sqlite_strict=True,
)

# One-time links for the first administrator and for everybody whom an administrator invites.
invitations = Table(
    "invitations",
    metadata,
    Column("token_sha256", Text, primary_key=True),
    Column("account", Text, nullable=False),  # "" for the first administrator, who chooses one
    Column("expires_utc_s", REAL, nullable=False),
    Column("used", Integer, nullable=False),
    sqlite_strict=True,
)

sessions = Table(
    "sessions",
    metadata,
    Column("token_sha256", Text, primary_key=True),
    Column("account", Text, ForeignKey("accounts.account"), nullable=False),
    Column("screen", Text, nullable=False, unique=True),  # a short name for people and for the record
    Column("csrf", Text, nullable=False),
    Column("created_utc_s", REAL, nullable=False),
    Column("seen_utc_s", REAL, nullable=False),  # last action of the person; the page's own requests do not count
    Column("locked", Integer, nullable=False),
    Column("pin_failures", Integer, nullable=False),
    sqlite_strict=True,
)

# Which screen may act on a run, and which one asks for control or was refused it.
control = Table(
    "control",
    metadata,
    Column("run_id", Text, ForeignKey("runs.run_id"), primary_key=True),
    Column("screen", Text, nullable=False),  # "" for nobody
    Column("account", Text, nullable=False),
    Column("asked_by_screen", Text, nullable=False),
    Column("asked_by_account", Text, nullable=False),
    Column("asked_utc_s", REAL, nullable=False),  # negative: that was refused, at the time without the sign
    sqlite_strict=True,
)

# Which artefacts another place holds: each row was confirmed by that place's own statement, and can be again.
copies = Table(
    "copies",
    metadata,
    Column("sha256", Text, nullable=False),
    Column("place", Text, nullable=False),
    Column("size_bytes", Integer, nullable=False),
    Column("at_utc", Text, nullable=False),  # when it was first confirmed
    Column("checked_utc", Text, nullable=False),  # when it was last confirmed
    PrimaryKeyConstraint("sha256", "place"),
    sqlite_strict=True,
)
