"""Add badges to accounts: the text that a badge reader types, hashed like a PIN."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("accounts", sa.Column("badge_hash", sa.Text, nullable=False, server_default=""))
