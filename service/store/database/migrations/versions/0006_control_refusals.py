"""Keep who refused whose request for control, so that the screen that asked can be told."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("control", sa.Column("refused_screen", sa.Text, nullable=False, server_default=""))
    op.add_column("control", sa.Column("refused_by_account", sa.Text, nullable=False, server_default=""))
    op.add_column("control", sa.Column("refused_utc_s", sa.REAL, nullable=False, server_default="0"))
