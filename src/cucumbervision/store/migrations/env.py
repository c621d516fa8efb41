"""Alembic's entry: runs the migrations on the connection that `engine.migrate` opened."""

from alembic import context

from cucumbervision.store.engine import VERSION_TABLE
from cucumbervision.store.schema import Base

if __name__ == "env_py":  # as Alembic loads it; who merely imports it has no database
    context.configure(
        connection=context.config.attributes["connection"],
        target_metadata=Base.metadata,
        version_table=VERSION_TABLE,
        transactional_ddl=True,  # SQLite too can take back what a transaction made
    )
    context.run_migrations()
