"""Whether the service can do its work."""

from fastapi import APIRouter, Request
from sqlalchemy import text

from accord.api import schemas
from accord.api.dependencies import app_state

router = APIRouter(tags=["service"])


@router.get("/health", summary="Is the service well?")
def health(request: Request) -> schemas.Health:
    """Asks the database; needs no sign-in. 503 with a sentence when it does not answer."""
    with app_state(request).database.reading() as session:
        session.execute(text("SELECT 1"))
    return schemas.Health(status="ok")
