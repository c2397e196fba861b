"""Writes service/store/database/new_schema.py from the migrations: `python -m tests.support.record.new_schema`."""

from __future__ import annotations

import json
import re
from pathlib import Path

from sqlalchemy import create_engine, text

from service.store.database import new_schema
from service.store.database.database import migrate

_PIECE = re.compile(r"\S.{0,98}(?:\s|\Z)|\s")  # of a line of a statement, with the space at its end
_HEAD = '''"""The statements that make a new database: what all migrations together make, without loading Alembic.

Written by `python -m tests.support.record.new_schema` after a migration was added; tests compare the two.
"""

from __future__ import annotations

STATEMENTS: tuple[str, ...] = (
'''


def migrated_statements() -> tuple[str, ...]:
    """The statements of the schema that the migrations make in an empty database, in their order."""
    made = create_engine("sqlite://")
    try:
        with made.begin() as connection:
            migrate(connection)
            schema = connection.execute(
                text("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL ORDER BY rowid")
            )
            rows = [(str(row.name), str(row.sql)) for row in schema]
    finally:
        made.dispose()
    full_text = {name for name, sql in rows if sql.startswith("CREATE VIRTUAL TABLE")}
    # SQLite makes the tables of a full-text index together with it.
    return tuple(sql for name, sql in rows if not any(name.startswith(f"{index}_") for index in full_text))


def module_text(statements: tuple[str, ...]) -> str:
    """The text of the module: each line of a statement is a string of its own, a long one several."""
    lines: list[str] = []
    for sql in statements:
        pieces = [piece for line in sql.splitlines(keepends=True) for piece in _PIECE.findall(line)]
        assert "".join(pieces) == sql
        if len(pieces) == 1:
            lines.append(f"    {_literal(pieces[0])},\n")
        else:
            lines += ["    (\n", *(f"        {_literal(piece)}\n" for piece in pieces), "    ),\n"]
    return f"{_HEAD}{''.join(lines)})\n"


def _literal(piece: str) -> str:
    return json.dumps(piece) if '"' not in piece else repr(piece)


if __name__ == "__main__":
    Path(new_schema.__file__).write_text(module_text(migrated_statements()), encoding="utf-8")
