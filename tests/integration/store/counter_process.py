"""Increments a counter in a database, beside other processes: python counter_process.py URL TIMES."""

import sys

from sqlalchemy import text

from accord.store.database import Database


def main() -> None:
    database = Database.open(sys.argv[1])
    for _ in range(int(sys.argv[2])):
        with database.transaction() as session:
            count = session.execute(text("SELECT restarts FROM workers")).scalar_one()
            session.execute(text("UPDATE workers SET restarts = :count"), {"count": count + 1})
    database.close()


if __name__ == "__main__":
    main()
