"""Leases and their ends."""

from datetime import datetime, timedelta

from accord.store.tables import utc_now


def now_and_end(lease_seconds: float) -> tuple[datetime, datetime]:
    """This moment, and the moment at which a lease taken now is over."""
    now = utc_now()
    return now, now + timedelta(seconds=lease_seconds)
