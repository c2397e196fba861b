"""Add the copies of artefacts in other places: an object store states that it holds them."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "copies",
        sa.Column("sha256", sa.Text, nullable=False),
        sa.Column("place", sa.Text, nullable=False),
        sa.Column("size_bytes", sa.Integer, nullable=False),
        sa.Column("at_utc", sa.Text, nullable=False),
        sa.Column("checked_utc", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("sha256", "place"),
        sqlite_strict=True,
    )
