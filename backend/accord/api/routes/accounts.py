"""Get the signed-in user, add users, sign in and out."""

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from accord.api import schemas
from accord.api.dependencies import COOKIE, AuthDep, app_state
from accord.api.pages import FOLDER, link_refused
from accord.domain.enums import Role
from accord.domain.errors import Unauthenticated
from accord.domain.permissions import may_manage_users, require
from accord.services import accounts

router = APIRouter(tags=["accounts"])
#: pages outside the API's prefix, opened in a browser
pages = APIRouter(include_in_schema=False)


@router.get("/me", summary="Get the signed-in user")
def me(auth: AuthDep) -> schemas.Me:
    """Returns the user whose token the request has."""
    with auth.reading() as caller:
        return schemas.Me(id=caller.user.id, name=caller.user.name, role=caller.role)


@router.post("/users", status_code=201, summary="Add a user")
def create_user(body: schemas.NewUser, request: Request, auth: AuthDep) -> schemas.CreatedUser:
    """Creates a user with a bearer token and a sign-in link. For admins only."""
    settings = auth.app.settings
    with auth.writing() as caller:
        require(may_manage_users(caller.role), caller.role, "add users")
        user, token = accounts.create_user(caller.session, body.name, body.role)
        link = accounts.make_link(caller.session, user.id, settings.link_minutes)
        base = settings.public_url or str(request.base_url)
        return schemas.CreatedUser(
            id=user.id,
            name=user.name,
            role=Role(user.role),
            token=token,
            sign_in_url=f"{base.rstrip('/')}/sign-in/{link}",
        )


@router.post("/sign-out", status_code=204, summary="Sign out")
def sign_out(auth: AuthDep) -> Response:
    """Ends the browser's session, or deletes the bearer token of the request."""
    with auth.writing() as caller:
        accounts.sign_out(caller.session, auth.token)
        response = Response(status_code=204)
        response.delete_cookie(COOKIE, path="/")
        return response


@pages.get("/sign-in/{link_token}")
def sign_in(link_token: str, request: Request) -> Response:
    """Redeems a one-time link: sets the browser's cookie and redirects to the page."""
    app = app_state(request)
    try:
        with app.database.transaction() as session:
            _, token = accounts.redeem_link(session, link_token, app.settings.session_days)
    except Unauthenticated as error:
        if _signed_in(request):
            return RedirectResponse("/", 303)
        return link_refused(str(error), FOLDER)
    secure = request.url.scheme == "https" or app.settings.public_url.startswith("https:")
    response = RedirectResponse("/", 303)
    response.set_cookie(
        COOKIE,
        token,
        max_age=round(app.settings.session_days * 86_400),
        httponly=True,
        samesite="lax",
        secure=secure,
        path="/",
    )
    return response


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
