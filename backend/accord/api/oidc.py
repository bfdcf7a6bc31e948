"""OpenID Connect: identifies people through the provider of the settings.

authlib makes the requests and checks the responses: state, PKCE, the signature of the ID token by the provider's keys,
its issuer, audience, nonce and expiry.
"""

import base64
import binascii
import json
from collections.abc import Iterable
from typing import Any, cast

import httpx2
from authlib.common.errors import AuthlibBaseError  # pyright: ignore[reportMissingTypeStubs]
from authlib.integrations.starlette_client import (  # pyright: ignore[reportMissingTypeStubs]
    StarletteIntegration,
    StarletteOAuth2App,
)
from fastapi import Request
from fastapi.responses import Response
from joserfc.errors import JoseError

from accord.domain.errors import ProviderUnreachable, SignInInvalid
from accord.services.identities import Identity
from accord.settings import Settings

#: The browser keeps state, nonce and PKCE verifier between both requests, so that any process of the server can finish
#: a sign-in, and only in the browser in which it began. The response deletes it.
STATE_COOKIE = "accord_oidc"
STATE_SECONDS = 600
_TIMEOUT_SECONDS = 10.0
#: how far the provider's clock may differ
_LEEWAY_SECONDS = 60
#: signatures by a public key; others would accept the client's secret, or nothing
_ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA")
_NAME_CLAIMS = ("name", "preferred_username", "email", "sub")
#: in OpenID Connect
_MAX_SUBJECT_CHARACTERS = 255
_NEXT = "next"


class Provider:
    """The provider of the settings. Reads its addresses and keys at the first sign-in."""

    def __init__(self, settings: Settings) -> None:
        self._issuer = settings.oidc_issuer
        self._groups_claim = settings.oidc_groups_claim if settings.oidc_roles else ""
        self._app = _app(settings)

    async def begin(self, request: Request, callback_url: str, next_path: str) -> Response:
        """Redirects the browser to the provider.

        Args:
            callback_url: to which the provider sends the browser back.
            next_path: of the page to show afterwards.

        Raises:
            ProviderUnreachable, SignInInvalid: as `finish`.
        """
        request.scope["session"] = state = {_NEXT: next_path}
        try:
            await self._metadata()
            response = cast(Response, await self._app.authorize_redirect(request, callback_url))
        except Exception as error:
            raise _translated(error) from error
        response.set_cookie(
            STATE_COOKIE,
            base64.urlsafe_b64encode(json.dumps(state).encode()).decode(),
            max_age=STATE_SECONDS,
            httponly=True,
            samesite="lax",
            secure=callback_url.startswith("https:"),
            path=request.url.path.rpartition("/")[0],
        )
        return response

    async def finish(self, request: Request) -> Identity:
        """Whom the provider identified. The request is that with which it sent the browser back.

        Raises:
            SignInInvalid: if something is missing, forged, expired or another sign-in's, or the person gave up.
            ProviderUnreachable: if the provider does not answer.
        """
        request.scope["session"] = _state(request)
        try:
            metadata = await self._metadata()
            token: dict[str, Any] = await self._app.authorize_access_token(
                request, claims_options={"iss": {"values": [self._issuer]}}, leeway=_LEEWAY_SECONDS
            )
            claims: dict[str, Any] = dict(token["userinfo"])
            subject = str(claims["sub"])
            if not 0 < len(subject) <= _MAX_SUBJECT_CHARACTERS:
                raise SignInInvalid
            wanted = ("name", *((self._groups_claim,) if self._groups_claim else ()))
            if "userinfo_endpoint" in metadata and not all(each in claims for each in wanted):
                more: dict[str, Any] = dict(await self._app.userinfo(token=token))
                if more.get("sub") != claims["sub"]:
                    raise SignInInvalid
                claims = more | claims
        except Exception as error:
            raise _translated(error) from error
        name = next(str(claims[each]) for each in _NAME_CLAIMS if claims.get(each))
        return Identity(self._issuer, subject, name, _groups(claims.get(self._groups_claim)))

    async def sign_out_url(self, callback_url: str) -> str | None:
        """Where the browser is signed out of the provider too; None if it has no such page.

        Raises:
            ProviderUnreachable, SignInInvalid: as `finish`.
        """
        try:
            if "end_session_endpoint" not in await self._metadata():
                return None
            ended = await self._app.create_logout_url(
                post_logout_redirect_uri=callback_url, client_id=self._app.client_id
            )
        except Exception as error:
            raise _translated(error) from error
        return str(ended["url"])

    async def _metadata(self) -> dict[str, Any]:
        metadata: dict[str, Any] = await self._app.load_server_metadata()
        if metadata.get("issuer") != self._issuer:
            metadata.pop("_loaded_at", None)  # read again the next time
            raise SignInInvalid(f"The provider calls itself {metadata.get('issuer')!r}, not {self._issuer!r}.")
        offered = metadata.get("id_token_signing_alg_values_supported") or ["RS256"]
        metadata["id_token_signing_alg_values_supported"] = [each for each in offered if each in _ALGORITHMS]
        return metadata


def next_path(request: Request) -> str:
    """The page that the browser wanted to see when it began to sign in."""
    return str(_state(request).get(_NEXT, "/"))


def _app(settings: Settings) -> Any:
    return StarletteOAuth2App(
        StarletteIntegration("oidc"),
        client_id=settings.oidc_client_id,
        client_secret=settings.oidc_client_secret.get_secret_value() or None,
        server_metadata_url=f"{settings.oidc_issuer.rstrip('/')}/.well-known/openid-configuration",
        client_kwargs={
            "scope": settings.oidc_scope,
            "code_challenge_method": "S256",
            "timeout": _TIMEOUT_SECONDS,
        },
    )


def _state(request: Request) -> dict[str, Any]:
    """What `begin` stored in the browser; empty if there is nothing, or something else."""
    try:
        state = json.loads(base64.urlsafe_b64decode(request.cookies.get(STATE_COOKIE, "")))
    except (binascii.Error, ValueError):
        return {}
    return cast("dict[str, Any]", state) if isinstance(state, dict) else {}


def _groups(claim: object) -> frozenset[str]:
    """Providers send a list, or one group as text."""
    if isinstance(claim, str):
        return frozenset({claim})
    return frozenset(map(str, cast("Iterable[object]", claim))) if isinstance(claim, list) else frozenset()


def _translated(error: Exception) -> Exception:
    """The exception of ours for one of the libraries; any other one as it is."""
    if isinstance(error, httpx2.HTTPError):
        return ProviderUnreachable()
    # What lacks parts that it must have makes authlib raise exceptions of Python.
    of_python = (ValueError, LookupError, TypeError, AttributeError, RuntimeError)
    if isinstance(error, (AuthlibBaseError, JoseError, *of_python)):
        return SignInInvalid()
    return error
