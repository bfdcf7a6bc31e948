"""Headers that restrict what browsers do with responses, and the hosts for which the server answers."""

import socket
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from accord.api.errors import accord_error_response
from accord.domain.addresses import as_address, is_loopback
from accord.domain.errors import HostNotAllowed
from accord.settings import Settings

#: The page loads its own files only. Clips are played from memory (`blob:`), and the API's description has images in
#: its styles (`data:`).
CONTENT_SECURITY_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob: data:",
        "media-src 'self' blob:",
        "connect-src 'self'",
        "font-src 'self'",
        "base-uri 'none'",
        "form-action 'self'",
        "frame-ancestors 'none'",
    )
)
_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    # Addresses of sign-in links and invitations contain their tokens.
    "Referrer-Policy": "same-origin",
}
_WILDCARDS = frozenset({"0.0.0.0", "::"})


class Security:
    """ASGI middleware: refuses requests for other hosts with 421, and adds the headers to every response.

    A page whose name an attacker points at this machine (DNS rebinding) would be of the same origin as Accord to a
    browser, which would let it read responses.
    """

    def __init__(self, app: ASGIApp, settings: Settings, clips_url: str | None = None) -> None:
        """
        Args:
            clips_url: an address in the store to which browsers are redirected for clips; None if they are not.
        """
        self.app = app
        self._hosts = AllowedHosts(settings)
        self._headers = _HEADERS
        if clips_url is not None:
            url = urlsplit(clips_url)
            policy = CONTENT_SECURITY_POLICY
            for directive in ("media-src 'self'", "connect-src 'self'"):
                policy = policy.replace(directive, f"{directive} {url.scheme}://{url.netloc}")
            self._headers = _HEADERS | {"Content-Security-Policy": policy}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(self._headers)
            await send(message)

        host = Headers(scope=scope).get("host", "")
        if host in self._hosts:
            await self.app(scope, receive, send_with_headers)
        else:
            await accord_error_response(HostNotAllowed(host))(scope, receive, send_with_headers)


class AllowedHosts:
    """The hosts for which a server answers.

    They are the loopback's, ACCORD_HOST, that of the public URL and ACCORD_ALLOWED_HOSTS. A server that listens on all
    addresses also answers for this machine's name, and for every address without a name: no DNS server resolves those.
    """

    def __init__(self, settings: Settings) -> None:
        named = {each.strip().lower() for each in settings.allowed_hosts.split(",")}
        self._all = "*" in named
        self._any_address = settings.host in _WILDCARDS
        public = urlsplit(settings.public_url).hostname
        self._names = named | {settings.host.lower(), public or ""}
        if self._any_address:
            self._names |= {socket.gethostname().lower()}
        self._names -= {""}

    def __contains__(self, host: str) -> bool:
        """Whether the `Host` of a request, with or without a port, is among them."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        any_address = self._any_address and as_address(name) is not None
        return self._all or name in self._names or is_loopback(name) or any_address
