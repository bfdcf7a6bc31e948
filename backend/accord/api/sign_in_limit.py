"""Limits how often one address may try tokens, sign-in links and invitations that are not valid."""

import hashlib
import ipaddress
from collections import OrderedDict

from limits import RateLimitItemPerMinute
from limits.storage import MemoryStorage
from limits.strategies import FixedWindowRateLimiter

from accord.domain.errors import TooManyFailedSignIns

#: tokens that were valid, kept so that their users are let in from an address that has reached the limit
_MAX_KNOWN_TOKENS = 10_000
#: a provider gives each customer at least this many bits of IPv6 addresses
_IPV6_CUSTOMER_BITS = 64


class SignInLimit:
    """Counts failures by client address, in this process. Threads may share it.

    A token that was valid before is never refused here: people behind one address, such as a university's, are not
    locked out by a stranger or a forgotten program among them.
    """

    def __init__(self, failures_per_minute: int) -> None:
        self._limit = RateLimitItemPerMinute(failures_per_minute)
        self._failures = FixedWindowRateLimiter(MemoryStorage())
        self._known: OrderedDict[bytes, None] = OrderedDict()

    def check(self, address: str, token: str = "") -> None:
        """Raises TooManyFailedSignIns if the address reached its limit, unless the token was valid before."""
        if not self._failures.test(self._limit, _customer(address)) and _digest(token) not in self._known:
            raise TooManyFailedSignIns

    def failed(self, address: str, token: str = "") -> None:
        """Count a token, link or invitation that is not valid."""
        self._known.pop(_digest(token), None)
        self._failures.hit(self._limit, _customer(address))

    def succeeded(self, token: str) -> None:
        """Remember a valid token."""
        digest = _digest(token)
        if digest not in self._known:
            self._known[digest] = None
            while len(self._known) > _MAX_KNOWN_TOKENS:
                self._known.popitem(last=False)


def _customer(address: str) -> str:
    """What one client can have many of counts as one address."""
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address
    if parsed.version == 4:
        return address
    return str(ipaddress.ip_network((parsed, _IPV6_CUSTOMER_BITS), strict=False))


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode(errors="surrogatepass")).digest()
