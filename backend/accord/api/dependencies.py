"""One request: who asks, and its one transaction.

A route opens the transaction itself, in the thread that it runs in, and returns its answer from inside the block: what
was written is committed before the first byte of the response. The more usual way, a session from a dependency with
`yield`, would hold the database's write lock between two visits to the thread pool; with more requests at once than the
pool has threads, all threads wait for the lock and its holder waits for a thread.
"""

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, cast
from urllib.parse import urlsplit

from fastapi import Depends, Path, Request
from fastapi.responses import Response
from pydantic import AfterValidator, BaseModel
from sqlalchemy.orm import Session

from accord.domain.enums import Role
from accord.domain.errors import Forbidden, Unauthenticated
from accord.domain.ids import check_id
from accord.services import accounts
from accord.settings import Settings
from accord.store.accounts import User
from accord.store.blobs import BlobStore
from accord.store.database import Database

COOKIE = "accord_session"
_SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})


@dataclass(frozen=True, slots=True)
class House:
    """What the application was made with."""

    settings: Settings
    database: Database
    blobs: BlobStore


@dataclass(frozen=True, slots=True)
class Signed:
    """An open transaction and the user on whose behalf it runs."""

    session: Session
    user: User
    role: Role


@dataclass(frozen=True, slots=True)
class Visit:
    """A request with a token, not yet known to be a good one."""

    house: House
    token: str

    @contextmanager
    def writing(self) -> Generator[Signed]:
        """A transaction that may write, committed at the block's end. Raises Unauthenticated."""
        with self.house.database.transaction() as session:
            yield self._signed(session)

    @contextmanager
    def reading(self) -> Generator[Signed]:
        """A transaction that only reads. Raises Unauthenticated."""
        with self.house.database.reading() as session:
            yield self._signed(session)

    def _signed(self, session: Session) -> Signed:
        user = accounts.authenticate(session, self.token)
        return Signed(session, user, Role(user.role))


def house_of(request: Request) -> House:
    return cast(House, request.app.state.house)


async def visit_of(request: Request) -> Visit:
    """Takes the token from the request, without a look into the database.

    Raises:
        Unauthenticated: if there is none.
        Forbidden: if a page of another site makes the browser send its cookie with a request that writes.
    """
    scheme, _, bearer = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer" and bearer.strip():
        return Visit(house_of(request), bearer.strip())
    cookie = request.cookies.get(COOKIE)
    if not cookie:
        raise Unauthenticated
    if request.method not in _SAFE_METHODS:
        _require_same_origin(request)
    return Visit(house_of(request), cookie)


def _require_same_origin(request: Request) -> None:
    """The cookie travels with every request to this host, whoever makes it; these headers only the browser writes."""
    site = request.headers.get("sec-fetch-site")
    origin = request.headers.get("origin")
    if site == "same-origin":
        return
    if site is None and origin is not None:
        public = urlsplit(house_of(request).settings.public_url).netloc
        if urlsplit(origin).netloc in {request.headers.get("host", ""), public} - {""}:
            return
    raise Forbidden(
        "This request came with the browser's cookie but not from Accord's own page. "
        "A program sends `Authorization: Bearer <token>` instead."
    )


VisitDep = Annotated[Visit, Depends(visit_of)]


def _experiment_id(id: str) -> str:
    return check_id(id, "exp")


def _query_id(id: str) -> str:
    return check_id(id, "qry")


def _clip_id(id: str) -> str:
    return check_id(id, "clp")


def _segment_id(id: str) -> str:
    return check_id(id, "seg")


ExperimentId = Annotated[str, AfterValidator(_experiment_id), Path(description="The experiment, exp_...")]
QueryId = Annotated[str, AfterValidator(_query_id), Path(description="The query, qry_...")]
ClipId = Annotated[str, AfterValidator(_clip_id), Path(description="The clip, clp_...")]
SegmentId = Annotated[str, AfterValidator(_segment_id), Path(description="The segment, seg_...")]


def answer(model: BaseModel, status: int = 200) -> Response:
    """A model as JSON, written once: a model that a route returns as it is would be validated a second time."""
    return Response(model.model_dump_json(), status, media_type="application/json")
