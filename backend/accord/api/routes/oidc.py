"""Sign in through an OpenID Connect provider."""

import logging
from typing import Annotated, Any

from anyio.to_thread import run_sync
from fastapi import APIRouter, Query, Request
from fastapi.responses import RedirectResponse, Response

from accord.api import schemas
from accord.api.dependencies import (
    AppState,
    address_of_client,
    app_state,
    base_url,
    counting_failures,
    set_session_cookie,
)
from accord.api.oidc import STATE_COOKIE, Provider, next_path
from accord.domain.enums import AuditAction, Role
from accord.domain.errors import AccordError, NotFound, SignInInvalid
from accord.services import accounts, audit, identities
from accord.services.identities import Identity

log = logging.getLogger(__name__)

router = APIRouter(tags=["accounts"], prefix="/oidc")
_REDIRECT: dict[int | str, dict[str, Any]] = {303: {"description": "Redirects the browser."}}
#: a path of this server's page: another host would begin with two slashes
_LOCAL_PATH = r"^/([!-.0-\[\]-~][!-~]*)?$"


class NoProvider(NotFound):
    """No provider is configured."""

    code = "no_provider"

    def __init__(self) -> None:
        AccordError.__init__(self, "People do not sign in through a provider here. Use a sign-in link.")


@router.get("", summary="Get the identity provider")
def get_oidc(request: Request) -> schemas.IdentityProvider:
    """The provider through which people can sign in, if there is one. Needs no authentication."""
    settings = app_state(request).settings
    return schemas.IdentityProvider(name=settings.oidc_name if settings.oidc_issuer else None)


@router.get("/start", status_code=303, response_class=Response, responses=_REDIRECT, summary="Sign in by the provider")
async def start_oidc(
    request: Request,
    next: Annotated[
        str, Query(max_length=1000, pattern=_LOCAL_PATH, description="Path of the page to show afterwards.")
    ] = "/",
) -> Response:
    """Sends the browser to the provider, which sends it back to `/oidc/callback`. Needs no authentication."""
    app, provider = _provider(request)
    try:
        app.sign_in_limit.check(address_of_client(request))
        return await provider.begin(
            request, f"{base_url(request)}{request.url.path.removesuffix('start')}callback", next
        )
    except AccordError as error:
        return _failed(error)


@router.get(
    "/callback", status_code=303, response_class=Response, responses=_REDIRECT, summary="Return from the provider"
)
async def finish_oidc(request: Request) -> Response:
    """Signs this browser in as whom the provider identified, and shows the page. Needs no authentication.

    The page says why if that fails.
    """
    app, provider = _provider(request)
    try:
        app.sign_in_limit.check(address_of_client(request))
        try:
            identity: Identity | AccordError = await provider.finish(request)
        except SignInInvalid as error:
            log.warning("A sign-in through the provider failed: %s", error.__cause__ or error)
            identity = error
        session_token = await run_sync(_sign_in, request, app, identity)
    except AccordError as error:
        response = _failed(error)
    else:
        response = RedirectResponse(next_path(request), 303)
        set_session_cookie(response, session_token, request)
    # With its state, the sign-in cannot be repeated.
    response.delete_cookie(STATE_COOKIE, path=request.url.path.rpartition("/")[0])
    return response


@router.get(
    "/sign-out", status_code=303, response_class=Response, responses=_REDIRECT, summary="Sign out of the provider"
)
async def end_oidc(request: Request) -> Response:
    """Sends the browser to the provider to sign out there too, after `POST /sign-out`. Needs no authentication."""
    app, provider = _provider(request)
    home = f"{base_url(request)}/"
    try:
        app.sign_in_limit.check(address_of_client(request))
        return RedirectResponse(await provider.sign_out_url(home) or home, 303)
    except AccordError as error:
        return _failed(error)


def _provider(request: Request) -> tuple[AppState, Provider]:
    app = app_state(request)
    if app.provider is None:
        raise NoProvider
    return app, app.provider


def _sign_in(request: Request, app: AppState, identity: Identity | AccordError) -> str:
    """The token of a new browser session. Blocks on the database. Raises the error, which counts as a failure."""
    settings = app.settings
    with counting_failures(request, request.query_params.get("state", ""), "identity provider"):
        if isinstance(identity, AccordError):
            raise identity
        with app.database.transaction() as session:
            user = identities.sign_in(
                session,
                identity,
                group_roles=settings.oidc_group_roles,
                other_role=Role(settings.oidc_role) if settings.oidc_role else None,
            )
            token = accounts.start_session(session, user, settings.session_days)
            audit.record(session, user, AuditAction.SIGNED_IN, provider=identity.issuer)
            return token


def _failed(error: AccordError) -> Response:
    """The page, which says why: the browser shows what this responds."""
    return RedirectResponse(f"/?sign_in_error={error.code}", 303)
