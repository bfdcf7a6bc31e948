"""Limits how often one address may try tokens, sign-in links and invitations that are not valid, and counts them."""

import hashlib
import ipaddress
from collections import OrderedDict

from limits import RateLimitItemPerMinute
from limits.storage import MemoryStorage
from limits.strategies import FixedWindowRateLimiter

from accord.domain.addresses import as_address
from accord.domain.errors import TooManyFailedSignIns

#: tokens that were valid, kept so that their users are let in from an address that has reached the limit
_MAX_KNOWN_TOKENS = 10_000
#: A browser whose session has ended repeats its token every few seconds: that counts as a part of another guess.
_GUESS_COST, _REPEAT_COST = 10, 1
_MINUTE_SECONDS, _DAY_SECONDS = 60, 86_400
#: guesses of one address in a day at which the audit log gets an entry
_RECORDED_AT = frozenset(10**power for power in range(10))
#: most entries in a day, so that nobody can fill the disk
MAX_ENTRIES_PER_DAY = 200
#: a provider gives each customer at least this many bits of IPv6 addresses
_IPV6_CUSTOMER_BITS = 64


class SignInLimit:
    """Counts failures by client address, in this process. Threads may share it.

    A token that was valid before is never refused here: people behind one address, such as a university's, are not
    locked out by a stranger or a forgotten program among them.
    """

    def __init__(self, failures_per_minute: int) -> None:
        self._limit = RateLimitItemPerMinute(failures_per_minute * _GUESS_COST)
        self._counts = MemoryStorage()
        self._failures = FixedWindowRateLimiter(self._counts)
        self._known: OrderedDict[bytes, None] = OrderedDict()

    def check(self, address: str, token: str = "") -> None:
        """Raises TooManyFailedSignIns if the address reached its limit, unless the token was valid before."""
        if not self._failures.test(self._limit, customer_of(address)) and _digest(token) not in self._known:
            raise TooManyFailedSignIns

    def failed(self, address: str, token: str) -> int:
        """Count a token, link or invitation that is not valid.

        Returns:
            How many different ones the address has tried within a day, if the audit log should say so; otherwise 0. It
            should at powers of ten, so that it shows attacks, and cannot be filled by them.
        """
        customer, digest = customer_of(address), _digest(token)
        self._known.pop(digest, None)
        if self._counts.incr(f"token {customer} {digest.hex()}", _MINUTE_SECONDS) > 1:
            self._failures.hit(self._limit, customer, cost=_REPEAT_COST)
            return 0
        self._failures.hit(self._limit, customer, cost=_GUESS_COST)
        guesses = self._counts.incr(f"guesses {customer}", _DAY_SECONDS)
        if guesses not in _RECORDED_AT or self._counts.incr("entries", _DAY_SECONDS) > MAX_ENTRIES_PER_DAY:
            return 0
        return guesses

    def succeeded(self, token: str) -> None:
        """Remember a valid token."""
        digest = _digest(token)
        if digest not in self._known:
            self._known[digest] = None
            while len(self._known) > _MAX_KNOWN_TOKENS:
                self._known.popitem(last=False)


def customer_of(address: str) -> str:
    """What one client can have many of counts as one address."""
    parsed = as_address(address)
    if parsed is None or parsed.version == 4:
        return address
    return str(ipaddress.ip_network((parsed, _IPV6_CUSTOMER_BITS), strict=False))


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode(errors="surrogatepass")).digest()
