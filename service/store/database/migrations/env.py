"""Runs the migrations on the connection that service.store.database.engine hands over; never opens one itself."""

from alembic import context

from service.store.database.tables import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata)
with context.begin_transaction():
    context.run_migrations()
