"""Get the signed-in user, sign in and out, and join by an invitation."""

from contextlib import suppress
from typing import Annotated

from fastapi import APIRouter, Path, Request
from fastapi.responses import Response

from accord.api import schemas
from accord.api.dependencies import (
    COOKIE,
    AuthDep,
    app_state,
    counting_failures,
    refuse_other_sites,
    set_session_cookie,
)
from accord.domain.enums import AuditAction, Role
from accord.domain.errors import Unauthenticated, Unavailable
from accord.services import accounts, audit, experiments, invitations

router = APIRouter(tags=["accounts"])

InvitationToken = Annotated[str, Path(max_length=200, description="The last part of the invitation's link.")]
LinkToken = Annotated[str, Path(max_length=200, description="The last part of the sign-in link.")]


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
        audit.record(caller.session, caller.user, AuditAction.SIGNED_OUT)
        response = Response(status_code=204)
        response.delete_cookie(COOKIE, path="/")
        return response


@router.get("/join/{token}", summary="Look at an invitation")
def get_join(token: InvitationToken, request: Request) -> schemas.InvitationView:
    """Says what an invitation is for. Needs no authentication, and uses nothing up."""
    with counting_failures(request, token, "invitation"), app_state(request).database.reading() as session:
        row = invitations.valid(session, token)
        experiment = None if row.experiment_id is None else experiments.get(session, row.experiment_id).name
        return schemas.InvitationView(experiment=experiment, invited_by=row.created_by)


@router.post("/join/{token}", status_code=201, summary="Join by an invitation")
def join(token: InvitationToken, body: schemas.NewMember, request: Request, response: Response) -> schemas.Member:
    """Creates a labeller and signs this browser in. Needs no authentication."""
    refuse_other_sites(request)
    app = app_state(request)
    with counting_failures(request, token, "invitation"), app.database.transaction() as session:
        experiment_id = invitations.valid(session, token).experiment_id
        user, session_token = invitations.join(session, token, body.name, app.settings.session_days)
        audit.record(session, user, AuditAction.JOINED, experiment_id)
        member = schemas.Member(id=user.id, name=user.name, role=Role(user.role), experiment_id=experiment_id)
    set_session_cookie(response, session_token, request)
    return member


@router.get("/sign-in/{token}", summary="Look at a sign-in link")
def get_sign_in(token: LinkToken, request: Request) -> schemas.SignInView:
    """Says whom a one-time link signs in. Needs no authentication, and uses nothing up.

    Chat programs open links to preview them: only the button on the page redeems one.
    """
    with counting_failures(request, token, "sign-in link"), app_state(request).database.reading() as session:
        user = accounts.user_of_link(session, token)
        return schemas.SignInView(name=user.name, role=Role(user.role))


@router.post("/sign-in/{token}", summary="Sign in by a link")
def sign_in(token: LinkToken, request: Request, response: Response) -> schemas.Me:
    """Redeems a one-time link: signs this browser in. Needs no authentication."""
    refuse_other_sites(request)
    app = app_state(request)
    with counting_failures(request, token, "sign-in link"), app.database.transaction() as session:
        user, session_token = accounts.redeem_link(session, token, app.settings.session_days)
        audit.record(session, user, AuditAction.SIGNED_IN)
        signed_in = schemas.Me(id=user.id, name=user.name, role=Role(user.role))
    set_session_cookie(response, session_token, request)
    return signed_in
