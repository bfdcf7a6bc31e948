"""Get the signed-in user, sign in and out, and join by an invitation."""

from contextlib import suppress
from typing import Annotated

from fastapi import APIRouter, Path, Request
from fastapi.responses import RedirectResponse, Response

from accord.api import schemas
from accord.api.dependencies import COOKIE, AppState, AuthDep, app_state, counting_failures
from accord.api.pages import FOLDER, link_refused
from accord.domain.enums import Role
from accord.domain.errors import Unauthenticated, Unavailable
from accord.services import accounts, experiments, invitations

router = APIRouter(tags=["accounts"])
#: pages outside the API's prefix, opened in a browser
pages = APIRouter(include_in_schema=False)

InvitationToken = Annotated[str, Path(max_length=200, description="The last part of the invitation's link.")]


@router.get("/me", summary="Get the signed-in user")
def me(auth: AuthDep) -> schemas.Me:
    """Returns the user whose token the request has."""
    with auth.reading() as caller:
        user = schemas.Me(id=caller.user.id, name=caller.user.name, role=caller.role)
        seen = accounts.was_seen_lately(caller.user)
    if not seen:
        # Every page asks for its user first. A full disk must not sign anybody out.
        with suppress(Unavailable, Unauthenticated), auth.writing():
            pass
    return user


@router.post("/sign-out", status_code=204, summary="Sign out")
def sign_out(auth: AuthDep) -> Response:
    """Ends the browser's session, or deletes the bearer token of the request."""
    with auth.writing() as caller:
        accounts.sign_out(caller.session, auth.token)
        response = Response(status_code=204)
        response.delete_cookie(COOKIE, path="/")
        return response


@router.get("/join/{token}", summary="Look at an invitation")
def get_join(token: InvitationToken, request: Request) -> schemas.InvitationView:
    """Says what an invitation is for. Needs no authentication, and uses nothing up."""
    with counting_failures(request), app_state(request).database.reading() as session:
        row = invitations.valid(session, token)
        experiment = None if row.experiment_id is None else experiments.get(session, row.experiment_id).name
        return schemas.InvitationView(experiment=experiment, invited_by=row.created_by)


@router.post("/join/{token}", status_code=201, summary="Join by an invitation")
def join(token: InvitationToken, body: schemas.NewMember, request: Request, response: Response) -> schemas.Member:
    """Creates a labeller and signs this browser in. Needs no authentication."""
    app = app_state(request)
    with counting_failures(request), app.database.transaction() as session:
        experiment_id = invitations.valid(session, token).experiment_id
        user, session_token = invitations.join(session, token, body.name, app.settings.session_days)
        member = schemas.Member(id=user.id, name=user.name, role=Role(user.role), experiment_id=experiment_id)
    _set_cookie(response, session_token, request, app)
    return member


@pages.get("/sign-in/{link_token}")
def sign_in(link_token: str, request: Request) -> Response:
    """Redeems a one-time link: sets the browser's cookie and redirects to the page."""
    app = app_state(request)
    try:
        with counting_failures(request), app.database.transaction() as session:
            _, token = accounts.redeem_link(session, link_token, app.settings.session_days)
    except Unauthenticated as error:
        if _signed_in(request):
            return RedirectResponse("/", 303)
        return link_refused(str(error), FOLDER)
    response = RedirectResponse("/", 303)
    _set_cookie(response, token, request, app)
    return response


def _set_cookie(response: Response, token: str, request: Request, app: AppState) -> None:
    response.set_cookie(
        COOKIE,
        token,
        max_age=round(app.settings.session_days * 86_400),
        httponly=True,
        samesite="lax",
        secure=request.url.scheme == "https" or app.settings.public_url.startswith("https:"),
        path="/",
    )


def _signed_in(request: Request) -> bool:
    """Whether the browser has a valid cookie: it may have opened its used link again."""
    cookie = request.cookies.get(COOKIE)
    if not cookie:
        return False
    with app_state(request).database.reading() as session:
        try:
            accounts.authenticate(session, cookie)
        except Unauthenticated:
            return False
        return True
