"""The tables for SQLAlchemy. The migrations create them; a test checks that the two agree."""

from __future__ import annotations

from sqlalchemy import (
    REAL,
    BigInteger,
    CheckConstraint,
    Column,
    Double,
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
# Migrations use these, too: PostgreSQL's REAL and INTEGER have four bytes, and its texts are sorted by a language.
INTEGER = Integer().with_variant(BigInteger(), "postgresql")
DOUBLE = REAL().with_variant(Double(), "postgresql")
TEXT = Text().with_variant(Text(collation="C"), "postgresql")

runs = Table(
    "runs",
    metadata,
    Column("run_id", TEXT, primary_key=True),
    Column("created_utc", TEXT, nullable=False),
    Column("simulated", INTEGER, nullable=False),
    Column("root_sha256", TEXT, nullable=False),
    CheckConstraint("simulated IN (0, 1)", name="runs_simulated"),
    sqlite_strict=True,
)

events = Table(
    "events",
    metadata,
    Column("run_id", TEXT, ForeignKey("runs.run_id"), nullable=False),
    Column("seq", INTEGER, nullable=False),
    Column("kind", TEXT, nullable=False),
    Column("at_utc", TEXT, nullable=False),
    Column("monotonic_s", DOUBLE, nullable=False),
    Column("actor", TEXT, nullable=False),
    Column("payload", TEXT, nullable=False),  # RFC 8785 canonical JSON
    Column("previous_sha256", TEXT, nullable=False),
    Column("sha256", TEXT, nullable=False),
    PrimaryKeyConstraint("run_id", "seq"),
    UniqueConstraint("run_id", "previous_sha256", name="events_no_fork"),
    CheckConstraint("seq >= 1", name="events_seq"),
    CheckConstraint("length(sha256) = 64 AND length(previous_sha256) = 64", name="events_hash_length"),
    sqlite_strict=True,
)

# The index by which auditors filter and search events (service.store.event_index). There is also the full-text index
# `event_words` (FTS5, contentless, rowid = position), which SQLAlchemy cannot describe.
event_index = Table(
    "event_index",
    metadata,
    Column("position", INTEGER, primary_key=True),  # over all runs, in the order of writing
    Column("run_id", TEXT, nullable=False),
    Column("seq", INTEGER, nullable=False),
    Column("kind", TEXT, nullable=False),
    Column("step", TEXT),
    Column("device", TEXT),
    Column("actor", TEXT, nullable=False),
    UniqueConstraint("run_id", "seq", name="event_index_once"),
    Index("event_index_by_kind", "run_id", "kind", "seq"),
    sqlite_strict=True,
)

# Single values of the payloads by which events are found.
event_facets = Table(
    "event_facets",
    metadata,
    Column("run_id", TEXT, nullable=False),
    Column("seq", INTEGER, nullable=False),
    Column("name", TEXT, nullable=False),
    Column("value", TEXT, nullable=False),
    PrimaryKeyConstraint("run_id", "seq", "name"),
    Index("event_facets_by_value", "name", "value", "run_id"),
    sqlite_strict=True,
    sqlite_with_rowid=False,
)

# The last event of each chain, written with every append, so that a truncated chain is found.
heads = Table(
    "heads",
    metadata,
    Column("run_id", TEXT, ForeignKey("runs.run_id"), primary_key=True),
    Column("seq", INTEGER, nullable=False),
    Column("sha256", TEXT, nullable=False),
    sqlite_strict=True,
)

artefacts = Table(
    "artefacts",
    metadata,
    Column("run_id", TEXT, nullable=False),
    Column("seq", INTEGER, nullable=False),  # of the event that brought it
    Column("position", INTEGER, nullable=False),  # 0, 1, 2 … within that event
    Column("sha256", TEXT, nullable=False),
    Column("kind", TEXT, nullable=False),
    Column("media_type", TEXT, nullable=False),
    Column("size_bytes", INTEGER, nullable=False),
    Column("original_name", TEXT, nullable=False),
    Column("device", TEXT, nullable=False),
    Column("step", TEXT),
    Column("attempt", INTEGER),
    Column("viewpoint", TEXT),
    Column("who", TEXT, nullable=False),
    Column("at_utc", TEXT, nullable=False),
    Column("monotonic_s", DOUBLE, nullable=False),
    Column("record_sha256", TEXT, nullable=False),  # over all of the above and the event's sha256
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
    Column("position", INTEGER, primary_key=True),  # order of claiming
    Column("job_id", TEXT, nullable=False, unique=True),
    Column("run_id", TEXT, nullable=False),
    Column("kind", TEXT, nullable=False),
    Column("step", TEXT, nullable=False),
    Column("attempt", INTEGER, nullable=False),  # of the step
    Column("idempotency_key", TEXT, nullable=False),
    Column("arguments", TEXT, nullable=False),  # RFC 8785 canonical JSON
    Column("state", TEXT, nullable=False),
    Column("tries", INTEGER, nullable=False),  # how often a worker has claimed it
    Column("try_limit", INTEGER, nullable=False),
    Column("enqueued_seq", INTEGER, nullable=False),
    Column("enqueued_utc", TEXT, nullable=False),
    Column("started_utc", TEXT),
    Column("ended_utc", TEXT),
    Column("ended_seq", INTEGER),
    Column("error", TEXT),
    Column("worker", TEXT),
    Column("token", TEXT),
    Column("until_utc_s", DOUBLE),
    Column("host", TEXT),
    Column("boot", TEXT),
    Column("pid", INTEGER),
    Column("process_started_s", DOUBLE),
    Column("priority", INTEGER, nullable=False, server_default="1"),  # smaller is claimed first
    ForeignKeyConstraint(["run_id", "enqueued_seq"], ["events.run_id", "events.seq"]),
    UniqueConstraint("run_id", "idempotency_key", name="jobs_idempotency"),
    CheckConstraint("state IN ('queued', 'running', 'finished', 'failed')", name="jobs_state"),
    Index("jobs_open", "state", "position"),
    sqlite_strict=True,
)

leases = Table(
    "leases",
    metadata,
    Column("run_id", TEXT, ForeignKey("runs.run_id"), primary_key=True),
    Column("holder", TEXT, nullable=False),
    Column("token", TEXT, nullable=False),
    Column("until_utc_s", DOUBLE, nullable=False),
    Column("host", TEXT, nullable=False),
    Column("boot", TEXT, nullable=False),
    Column("pid", INTEGER, nullable=False),
    Column("process_started_s", DOUBLE, nullable=False),
    sqlite_strict=True,
)

# Signatures over the chains; each covers every event up to its own.
checkpoints = Table(
    "checkpoints",
    metadata,
    Column("run_id", TEXT, nullable=False),
    Column("seq", INTEGER, nullable=False),  # of the last event that it covers
    Column("sha256", TEXT, nullable=False),  # of that event
    Column("artefacts_sha256", TEXT, nullable=False),  # over record_sha256 of the artefact rows up to it
    Column("site_seq", INTEGER, nullable=False),  # end of the site's chain, which tells the valid key
    Column("site_sha256", TEXT, nullable=False),
    Column("at_utc", TEXT, nullable=False),
    Column("key_id", TEXT, nullable=False),  # SHA-256 of the raw public key
    Column("signature", TEXT, nullable=False),  # base64, Ed25519 over service.store.signatures.checkpoints.statement
    PrimaryKeyConstraint("run_id", "seq"),
    ForeignKeyConstraint(["run_id", "seq"], ["events.run_id", "events.seq"]),
    sqlite_strict=True,
)

# Time stamps on checkpoints (RFC 3161).
timestamps = Table(
    "timestamps",
    metadata,
    Column("run_id", TEXT, nullable=False),
    Column("seq", INTEGER, nullable=False),  # of the checkpoint
    Column("authority", TEXT, nullable=False),
    Column("at_utc", TEXT, nullable=False),
    Column("token", TEXT, nullable=False),  # base64 of the DER TimeStampResp
    PrimaryKeyConstraint("run_id", "seq", "authority"),
    ForeignKeyConstraint(["run_id", "seq"], ["checkpoints.run_id", "checkpoints.seq"]),
    sqlite_strict=True,
)

# People. The rows are the present state; every change is recorded in the site's chain.
accounts = Table(
    "accounts",
    metadata,
    Column("account", TEXT, primary_key=True),  # the name to sign in with
    Column("full_name", TEXT, nullable=False),
    Column("role", TEXT, nullable=False),
    Column("state", TEXT, nullable=False),
    Column("password_hash", TEXT, nullable=False),  # argon2id; "" while invited
    Column("pin_hash", TEXT, nullable=False),  # argon2id; "" for none
    Column("failures", INTEGER, nullable=False),  # in a row
    Column("locked_until_utc_s", DOUBLE, nullable=False),
    Column("created_utc", TEXT, nullable=False),
    Column("badge_hash", TEXT, nullable=False, server_default=""),  # argon2id; "" for none
    CheckConstraint("role IN ('technician', 'supervisor', 'auditor', 'administrator')", name="accounts_role"),
    CheckConstraint("state IN ('invited', 'active', 'disabled')", name="accounts_state"),
    sqlite_strict=True,
)

# One-time links for the first administrator and for everybody whom an administrator invites.
invitations = Table(
    "invitations",
    metadata,
    Column("token_sha256", TEXT, primary_key=True),
    Column("account", TEXT, nullable=False),  # "" for the first administrator, who chooses one
    Column("expires_utc_s", DOUBLE, nullable=False),
    Column("used", INTEGER, nullable=False),
    sqlite_strict=True,
)

sessions = Table(
    "sessions",
    metadata,
    Column("token_sha256", TEXT, primary_key=True),
    Column("account", TEXT, ForeignKey("accounts.account"), nullable=False),
    Column("screen", TEXT, nullable=False, unique=True),  # a short name for people and for the record
    Column("csrf", TEXT, nullable=False),
    Column("created_utc_s", DOUBLE, nullable=False),
    Column("seen_utc_s", DOUBLE, nullable=False),  # last action of the person; the page's own requests do not count
    Column("locked", INTEGER, nullable=False),
    Column("pin_failures", INTEGER, nullable=False),
    sqlite_strict=True,
)

# Which screen may act on a run, and which one asks for control or was refused it.
control = Table(
    "control",
    metadata,
    Column("run_id", TEXT, ForeignKey("runs.run_id"), primary_key=True),
    Column("screen", TEXT, nullable=False),  # "" for nobody
    Column("account", TEXT, nullable=False),
    Column("asked_by_screen", TEXT, nullable=False),
    Column("asked_by_account", TEXT, nullable=False),
    Column("asked_utc_s", DOUBLE, nullable=False),  # negative: that was refused, at the time without the sign
    sqlite_strict=True,
)

# Which artefacts another place holds: each row was confirmed by that place's own statement, and can be again.
copies = Table(
    "copies",
    metadata,
    Column("sha256", TEXT, nullable=False),
    Column("place", TEXT, nullable=False),
    Column("size_bytes", INTEGER, nullable=False),
    Column("at_utc", TEXT, nullable=False),  # when it was first confirmed
    Column("checked_utc", TEXT, nullable=False),  # when it was last confirmed
    PrimaryKeyConstraint("sha256", "place"),
    sqlite_strict=True,
)
