"""Versions of the plant model."""

from datetime import datetime

from fastapi import APIRouter
from pydantic import BaseModel, Field
from sqlalchemy.orm import Session

from service.base.fields import from_row
from service.store.model_versions import declared_of
from service.store.tables import ModelRow
from service.twin import model_versions
from service.web.auth.dependencies import READ, RuntimeDep
from service.web.responses.lists import Page
from service.web.responses.openapi import problems

router = APIRouter(tags=["studies"])


class ModelOut(BaseModel):
    """A version of the plant model."""

    version: int = Field(description="Ask for it as `model_version`.")
    is_current: bool = Field(description="Whether forecasts and predictions are made by it.")
    effects: list[dict[str, object]] = Field(
        description="Its effects with parameters and scopes, but for declared ones."
    )
    declared: dict[str, object] | None = Field(
        description=(
            "What was declared when it was made, as in twin.json; null: Buie's sun with a ratio of"
            " 0.02."
        )
    )
    study: int | None = Field(
        description="The study that it was adopted from; null: a declared model."
    )
    adopted_at: datetime | None = Field(description="When it was adopted; null: declared.")
    adopted_by: str | None = Field(description="Name of the key that adopted it.")
    withdrawn_at: datetime | None = Field(description="When it was withdrawn; null: it was not.")
    withdrawn_by: str | None = Field(description="Name of the key that withdrew it.")
    reason: str | None = Field(description="Why it was adopted, as it was given.")
    withdrawn_reason: str | None = Field(description="Why it was withdrawn, as it was given.")


def declared_model(declared: dict[str, object] | None, is_current: bool) -> ModelOut:
    """The declared model, which is the first version."""
    unknown = dict.fromkeys(ModelOut.model_fields)
    about = {"version": model_versions.DECLARED, "effects": [], "declared": declared}
    return ModelOut.model_validate({**unknown, **about, "is_current": is_current})


def model_out(row: ModelRow, is_current: bool) -> ModelOut:
    """An adopted version of the plant model."""
    return from_row(ModelOut, row, version=row.number, is_current=is_current, study=row.study_id)


def all_models(session: Session) -> list[ModelOut]:
    """All versions of the plant model, oldest first, including withdrawn ones."""
    current = model_versions.current_number(session)
    adopted = [model_out(row, row.number == current) for row in model_versions.list_models(session)]
    return [
        declared_model(declared_of(session, None), current == model_versions.DECLARED),
        *adopted,
    ]


def current_out(session: Session) -> ModelOut:
    """The current version, adopted or declared."""
    row = model_versions.find_current(session)
    return (
        declared_model(declared_of(session, None), True)
        if row is None
        else model_out(row, is_current=True)
    )


@router.get("/models", responses=problems(), dependencies=[READ])
def list_models(runtime: RuntimeDep) -> Page[ModelOut]:
    """List the versions of the plant model, oldest first. Withdrawn ones are included."""
    with runtime.database.reading() as session:
        return Page(items=all_models(session), next=None)


@router.get("/models/current", responses=problems(), dependencies=[READ])
def get_current_model(runtime: RuntimeDep) -> ModelOut:
    """Get the current version of the plant model. Forecasts and predictions use it."""
    with runtime.database.reading() as session:
        return current_out(session)
