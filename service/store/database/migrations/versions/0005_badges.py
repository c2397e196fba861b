"""Accounts may have a badge: what a reader types of it, hashed as PINs are."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("accounts", sa.Column("badge_hash", sa.Text, nullable=False, server_default=""))
