"""A labeller as a process: python labeller_process.py URL EXPERIMENT TOKEN. Prints the ids of the queries it labels."""

import sys

from accord.services import accounts, label, lease
from accord.store.database import Database


def main() -> None:
    url, experiment_id, token = sys.argv[1:]
    database = Database.open(url)
    while True:
        with database.transaction() as session:
            user = accounts.authenticate(session, token)
            found = lease.next_queries(session, user, experiment_id, 1, 60.0)
        if not found.items:
            break
        with database.transaction() as session:
            user = accounts.authenticate(session, token)
            label.put_label(session, user, found.items[0].id, 1.0, "shown")
        print(found.items[0].id)
    database.close()


if __name__ == "__main__":
    main()
