"""Health check."""

from fastapi import APIRouter, Request
from sqlalchemy import text

from accord.api import schemas
from accord.api.dependencies import app_state
from accord.domain.errors import DatabaseUnreachable, Unavailable

router = APIRouter(tags=["service"])


@router.get("/health", summary="Check the service")
def health(request: Request) -> schemas.Health:
    """Checks whether the service works. Needs no authentication. Returns 503 if the service cannot work."""
    try:
        with app_state(request).database.reading() as session:
            session.execute(text("SELECT 1"))
    except DatabaseUnreachable as error:
        # Strangers may ask, and need not know what fails.
        raise Unavailable("Accord cannot work now. Its log says why.") from error
    return schemas.Health(status="ok")
