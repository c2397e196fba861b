"""Add checkpoints and time stamps (append-only), and people: accounts, invitations, sessions, control."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "checkpoints",
        sa.Column("run_id", sa.Text, nullable=False),
        sa.Column("seq", sa.Integer, nullable=False),
        sa.Column("sha256", sa.Text, nullable=False),
        sa.Column("artefacts_sha256", sa.Text, nullable=False),
        sa.Column("site_seq", sa.Integer, nullable=False),
        sa.Column("site_sha256", sa.Text, nullable=False),
        sa.Column("at_utc", sa.Text, nullable=False),
        sa.Column("key_id", sa.Text, nullable=False),
        sa.Column("signature", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("run_id", "seq"),
        sa.ForeignKeyConstraint(["run_id", "seq"], ["events.run_id", "events.seq"]),
        sqlite_strict=True,
    )
    op.create_table(
        "timestamps",
        sa.Column("run_id", sa.Text, nullable=False),
        sa.Column("seq", sa.Integer, nullable=False),
        sa.Column("authority", sa.Text, nullable=False),
        sa.Column("at_utc", sa.Text, nullable=False),
        sa.Column("token", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("run_id", "seq", "authority"),
        sa.ForeignKeyConstraint(["run_id", "seq"], ["checkpoints.run_id", "checkpoints.seq"]),
        sqlite_strict=True,
    )
    op.create_table(
        "accounts",
        sa.Column("account", sa.Text, primary_key=True),
        sa.Column("full_name", sa.Text, nullable=False),
        sa.Column("role", sa.Text, nullable=False),
        sa.Column("state", sa.Text, nullable=False),
        sa.Column("password_hash", sa.Text, nullable=False),
        sa.Column("pin_hash", sa.Text, nullable=False),
        sa.Column("failures", sa.Integer, nullable=False),
        sa.Column("locked_until_utc_s", sa.REAL, nullable=False),
        sa.Column("created_utc", sa.Text, nullable=False),
        sa.CheckConstraint("role IN ('technician', 'supervisor', 'auditor', 'administrator')", name="accounts_role"),
        sa.CheckConstraint("state IN ('invited', 'active', 'disabled')", name="accounts_state"),
        sqlite_strict=True,
    )
    op.create_table(
        "invitations",
        sa.Column("token_sha256", sa.Text, primary_key=True),
        sa.Column("account", sa.Text, nullable=False),
        sa.Column("expires_utc_s", sa.REAL, nullable=False),
        sa.Column("used", sa.Integer, nullable=False),
        sqlite_strict=True,
    )
    op.create_table(
        "sessions",
        sa.Column("token_sha256", sa.Text, primary_key=True),
        sa.Column("account", sa.Text, sa.ForeignKey("accounts.account"), nullable=False),
        sa.Column("screen", sa.Text, nullable=False, unique=True),
        sa.Column("csrf", sa.Text, nullable=False),
        sa.Column("created_utc_s", sa.REAL, nullable=False),
        sa.Column("seen_utc_s", sa.REAL, nullable=False),
        sa.Column("locked", sa.Integer, nullable=False),
        sa.Column("pin_failures", sa.Integer, nullable=False),
        sqlite_strict=True,
    )
    op.create_table(
        "control",
        sa.Column("run_id", sa.Text, sa.ForeignKey("runs.run_id"), primary_key=True),
        sa.Column("screen", sa.Text, nullable=False),
        sa.Column("account", sa.Text, nullable=False),
        sa.Column("asked_by_screen", sa.Text, nullable=False),
        sa.Column("asked_by_account", sa.Text, nullable=False),
        sa.Column("asked_utc_s", sa.REAL, nullable=False),
        sqlite_strict=True,
    )
    for table, taken in (
        ("checkpoints", "run_id = NEW.run_id AND seq = NEW.seq"),
        ("timestamps", "run_id = NEW.run_id AND seq = NEW.seq AND authority = NEW.authority"),
    ):
        for verb in ("update", "delete"):
            op.execute(
                f"CREATE TRIGGER {table}_no_{verb} BEFORE {verb.upper()} ON {table} "
                f"BEGIN SELECT RAISE(ABORT, '{table} is append-only: {verb} refused'); END"
            )
        op.execute(
            f"CREATE TRIGGER {table}_no_replace BEFORE INSERT ON {table} "
            f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {taken}) "
            f"BEGIN SELECT RAISE(ABORT, '{table} is append-only: replace refused'); END"
        )
