"""The SQLite database: tables, migrations, transactions and the write-ahead log."""
