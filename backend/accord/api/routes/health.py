"""Health check."""

from fastapi import APIRouter, Request
from sqlalchemy import text

from accord.api import schemas
from accord.api.dependencies import app_state

router = APIRouter(tags=["service"])


@router.get("/health", summary="Check the service")
def health(request: Request) -> schemas.Health:
    """Queries the database. Needs no authentication. Returns 503 if the database does not respond."""
    with app_state(request).database.reading() as session:
        session.execute(text("SELECT 1"))
    return schemas.Health(status="ok")
