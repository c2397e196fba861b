"""Add indexes by which auditors filter and search events: a narrow table, a full-text index and a trigger."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

# The actor and every text in the payload, in order. Numbers are not searched for.
_WORDS = (
    "{row}.actor || ' ' || "
    "coalesce((SELECT group_concat(atom, ' ') FROM json_tree({row}.payload) WHERE type = 'text'), '')"
)
_FACETS = (
    "{row}.run_id, {row}.seq, {row}.kind, json_extract({row}.payload, '$.step'), "
    "json_extract({row}.payload, '$.device'), {row}.actor"
)
_COLUMNS = "run_id, seq, kind, step, device, actor"


def upgrade() -> None:
    op.create_table(
        "event_index",
        sa.Column("position", sa.Integer, primary_key=True),
        sa.Column("run_id", sa.Text, nullable=False),
        sa.Column("seq", sa.Integer, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("step", sa.Text),
        sa.Column("device", sa.Text),
        sa.Column("actor", sa.Text, nullable=False),
        sa.UniqueConstraint("run_id", "seq", name="event_index_once"),
        sqlite_strict=True,
    )
    op.create_index("event_index_by_kind", "event_index", ["run_id", "kind", "seq"])
    # Contentless, because the events hold the words already; never updated, so column sizes are not needed.
    op.execute("CREATE VIRTUAL TABLE event_words USING fts5(words, content = '', columnsize = 0)")
    op.execute(
        f"INSERT INTO event_index ({_COLUMNS}) SELECT {_FACETS.format(row='e')} FROM events AS e "
        "ORDER BY e.at_utc, e.run_id, e.seq"
    )
    op.execute(
        f"INSERT INTO event_words (rowid, words) SELECT i.position, {_WORDS.format(row='e')} "
        "FROM event_index AS i JOIN events AS e ON e.run_id = i.run_id AND e.seq = i.seq ORDER BY i.position"
    )
    op.execute(
        "CREATE TRIGGER events_indexed AFTER INSERT ON events BEGIN "
        f"INSERT INTO event_index ({_COLUMNS}) VALUES ({_FACETS.format(row='NEW')}); "
        f"INSERT INTO event_words (rowid, words) VALUES (last_insert_rowid(), {_WORDS.format(row='NEW')}); END"
    )
    for verb in ("update", "delete"):
        op.execute(
            f"CREATE TRIGGER event_index_no_{verb} BEFORE {verb.upper()} ON event_index "
            f"BEGIN SELECT RAISE(ABORT, 'event_index is append-only: {verb} refused'); END"
        )
    op.execute(
        "CREATE TRIGGER event_index_no_replace BEFORE INSERT ON event_index WHEN EXISTS (SELECT 1 FROM event_index "
        "WHERE position = NEW.position OR (run_id = NEW.run_id AND seq = NEW.seq)) "
        "BEGIN SELECT RAISE(ABORT, 'event_index is append-only: replace refused'); END"
    )
