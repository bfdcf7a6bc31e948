"""Identifiers in addresses, checked before anything looks for them; and a quick way to answer."""

from typing import Annotated

from fastapi import Path
from fastapi.responses import Response
from pydantic import AfterValidator, BaseModel

from accord.domain.ids import check_id


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
