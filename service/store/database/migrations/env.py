"""Run the migrations on the connection that service.store.database.engine passes in."""

from alembic import context

from service.store.database.tables import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata)
with context.begin_transaction():
    context.run_migrations()
