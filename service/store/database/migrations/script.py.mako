"""${message}."""

import sqlalchemy as sa
from alembic import op

from service.store.database.database import refuse_changes
from service.store.database.tables import DOUBLE, INTEGER, TEXT

revision = ${repr(up_revision)}
down_revision = ${repr(down_revision)}
branch_labels = ${repr(branch_labels)}
depends_on = ${repr(depends_on)}


def upgrade() -> None:
    ${upgrades if upgrades else "pass"}
