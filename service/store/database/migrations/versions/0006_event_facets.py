"""Derive the index of events in the program instead of a trigger: facets as rows, and words that are cut alike."""

import sqlalchemy as sa
from alembic import op

from service.store.event_index import WORDS_TABLE, index_again

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.execute("DROP TRIGGER IF EXISTS events_indexed")
    op.execute("DROP TABLE IF EXISTS event_words")
    op.execute(WORDS_TABLE)
    op.create_table(
        "event_facets",
        sa.Column("run_id", sa.Text, nullable=False),
        sa.Column("seq", sa.Integer, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("value", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("run_id", "seq", "name"),
        sqlite_strict=True,
        sqlite_with_rowid=False,
    )
    op.create_index("event_facets_by_value", "event_facets", ["name", "value", "run_id"])
    for verb in ("update", "delete"):
        op.execute(
            f"CREATE TRIGGER event_facets_no_{verb} BEFORE {verb.upper()} ON event_facets "
            f"BEGIN SELECT RAISE(ABORT, 'event_facets is append-only: {verb} refused'); END"
        )
    op.execute(
        "CREATE TRIGGER event_facets_no_replace BEFORE INSERT ON event_facets "
        "WHEN EXISTS (SELECT 1 FROM event_facets WHERE run_id = NEW.run_id AND seq = NEW.seq AND name = NEW.name) "
        "BEGIN SELECT RAISE(ABORT, 'event_facets is append-only: replace refused'); END"
    )
    index_again(op.get_bind())
