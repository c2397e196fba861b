"""Runs, events, heads, artefacts, jobs and leases, with the triggers that make evidence append-only."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "runs",
        sa.Column("run_id", sa.Text, primary_key=True),
        sa.Column("created_utc", sa.Text, nullable=False),
        sa.Column("simulated", sa.Integer, nullable=False),
        sa.Column("root_sha256", sa.Text, nullable=False),
        sa.CheckConstraint("simulated IN (0, 1)", name="runs_simulated"),
        sqlite_strict=True,
    )
    op.create_table(
        "events",
        sa.Column("run_id", sa.Text, sa.ForeignKey("runs.run_id"), nullable=False),
        sa.Column("seq", sa.Integer, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("at_utc", sa.Text, nullable=False),
        sa.Column("monotonic_s", sa.REAL, nullable=False),
        sa.Column("actor", sa.Text, nullable=False),
        sa.Column("payload", sa.Text, nullable=False),
        sa.Column("previous_sha256", sa.Text, nullable=False),
        sa.Column("sha256", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("run_id", "seq"),
        sa.UniqueConstraint("run_id", "previous_sha256", name="events_no_fork"),
        sa.CheckConstraint("seq >= 1", name="events_seq"),
        sa.CheckConstraint("length(sha256) = 64 AND length(previous_sha256) = 64", name="events_hash_length"),
        sqlite_strict=True,
    )
    op.create_table(
        "heads",
        sa.Column("run_id", sa.Text, sa.ForeignKey("runs.run_id"), primary_key=True),
        sa.Column("seq", sa.Integer, nullable=False),
        sa.Column("sha256", sa.Text, nullable=False),
        sqlite_strict=True,
    )
    op.create_table(
        "artefacts",
        sa.Column("run_id", sa.Text, nullable=False),
        sa.Column("seq", sa.Integer, nullable=False),
        sa.Column("position", sa.Integer, nullable=False),
        sa.Column("sha256", sa.Text, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("media_type", sa.Text, nullable=False),
        sa.Column("size_bytes", sa.Integer, nullable=False),
        sa.Column("original_name", sa.Text, nullable=False),
        sa.Column("device", sa.Text, nullable=False),
        sa.Column("step", sa.Text),
        sa.Column("attempt", sa.Integer),
        sa.Column("viewpoint", sa.Text),
        sa.Column("who", sa.Text, nullable=False),
        sa.Column("at_utc", sa.Text, nullable=False),
        sa.Column("monotonic_s", sa.REAL, nullable=False),
        sa.Column("record_sha256", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("run_id", "seq", "position"),
        sa.ForeignKeyConstraint(["run_id", "seq"], ["events.run_id", "events.seq"]),
        sa.CheckConstraint("length(sha256) = 64", name="artefacts_hash_length"),
        sa.CheckConstraint("size_bytes >= 0", name="artefacts_size"),
        sqlite_strict=True,
    )
    op.create_index("artefacts_by_content", "artefacts", ["sha256"])
    op.create_table(
        "jobs",
        sa.Column("position", sa.Integer, primary_key=True),
        sa.Column("job_id", sa.Text, nullable=False, unique=True),
        sa.Column("run_id", sa.Text, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("step", sa.Text, nullable=False),
        sa.Column("attempt", sa.Integer, nullable=False),
        sa.Column("idempotency_key", sa.Text, nullable=False),
        sa.Column("arguments", sa.Text, nullable=False),
        sa.Column("state", sa.Text, nullable=False),
        sa.Column("tries", sa.Integer, nullable=False),
        sa.Column("try_limit", sa.Integer, nullable=False),
        sa.Column("enqueued_seq", sa.Integer, nullable=False),
        sa.Column("enqueued_utc", sa.Text, nullable=False),
        sa.Column("started_utc", sa.Text),
        sa.Column("ended_utc", sa.Text),
        sa.Column("ended_seq", sa.Integer),
        sa.Column("error", sa.Text),
        sa.Column("worker", sa.Text),
        sa.Column("token", sa.Text),
        sa.Column("until_utc_s", sa.REAL),
        sa.Column("host", sa.Text),
        sa.Column("boot", sa.Text),
        sa.Column("pid", sa.Integer),
        sa.Column("process_started_s", sa.REAL),
        sa.ForeignKeyConstraint(["run_id", "enqueued_seq"], ["events.run_id", "events.seq"]),
        sa.UniqueConstraint("run_id", "idempotency_key", name="jobs_idempotency"),
        sa.CheckConstraint("state IN ('queued', 'running', 'finished', 'failed')", name="jobs_state"),
        sqlite_strict=True,
    )
    op.create_index("jobs_open", "jobs", ["state", "position"])
    op.create_table(
        "leases",
        sa.Column("run_id", sa.Text, sa.ForeignKey("runs.run_id"), primary_key=True),
        sa.Column("holder", sa.Text, nullable=False),
        sa.Column("token", sa.Text, nullable=False),
        sa.Column("until_utc_s", sa.REAL, nullable=False),
        sa.Column("host", sa.Text, nullable=False),
        sa.Column("boot", sa.Text, nullable=False),
        sa.Column("pid", sa.Integer, nullable=False),
        sa.Column("process_started_s", sa.REAL, nullable=False),
        sqlite_strict=True,
    )
    for table in ("runs", "events", "artefacts"):
        for verb in ("update", "delete"):
            op.execute(
                f"CREATE TRIGGER {table}_no_{verb} BEFORE {verb.upper()} ON {table} "
                f"BEGIN SELECT RAISE(ABORT, '{table} is append-only: {verb} refused'); END"
            )
    # INSERT OR REPLACE deletes without firing a DELETE trigger, so inserting an existing key is refused.
    for table, taken in (
        ("runs", "run_id = NEW.run_id"),
        ("events", "run_id = NEW.run_id AND (seq = NEW.seq OR previous_sha256 = NEW.previous_sha256)"),
        ("artefacts", "run_id = NEW.run_id AND seq = NEW.seq AND position = NEW.position"),
    ):
        op.execute(
            f"CREATE TRIGGER {table}_no_replace BEFORE INSERT ON {table} "
            f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {taken}) "
            f"BEGIN SELECT RAISE(ABORT, '{table} is append-only: replace refused'); END"
        )
