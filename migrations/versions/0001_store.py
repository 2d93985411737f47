"""All tables, as `service.store.tables` and `service.store.job_tables` declare them.

Until 1.0.0 is released this is the only migration. After a change of the tables it gets another
``revision`` (a test names it), and stores of the former one are refused. The release writes the
tables out here, so that later migrations begin from them.
"""

from alembic import op

from service.store import job_tables, tables  # noqa: F401 - the metadata knows what was loaded
from service.store.columns import Base

revision = "ccf8878391bd"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    Base.metadata.create_all(op.get_bind(), checkfirst=False)


def downgrade() -> None:
    Base.metadata.drop_all(op.get_bind(), checkfirst=False)
