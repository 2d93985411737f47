"""The job `studies`: find an effect that photographs show and the model lacks."""

from pydantic import Field, ValidationInfo, field_validator

from model.effects import CATALOGUE
from service import store
from service.base.fields import Model, Moment, Name, Text, Whole
from service.jobs.kind import Context, Kind, Result
from service.twin.studies.study import StudyRequest, Surfaces, study_row, study_store

MAX_STUDY_IMAGES = 400  # bounds the memory of a study


class StudyIn(Model):
    """Find the effect that stored photographs show and the plant's current model lacks."""

    heliostats: list[Name] | None = Field(
        default=None,
        min_length=1,
        max_length=200,
        description="Names of heliostats; else some of all over the field.",
    )
    max_heliostats: Whole = Field(
        default=12,
        ge=1,
        le=200,
        description="How many heliostats to take where none is named, near ones and far ones.",
    )
    surfaces: Surfaces = Field(
        default="current",
        description=(
            "measured: only heliostats with a measured surface; current: where there is none, the"
            " newest prediction."
        ),
    )
    images: Whole = Field(
        default=12,
        ge=2,
        le=64,
        validate_default=True,
        description=(
            "Most photographs of each heliostat: the newest ones, spread over the sun's positions."
            f" {MAX_STUDY_IMAGES} of all heliostats together."
        ),
    )
    since: Moment | None = Field(
        default=None, description="Only photographs from then on (time with zone)."
    )
    until: Moment | None = Field(
        default=None, description="Only photographs before then (time with zone)."
    )
    candidates: list[Text] | None = Field(
        default=None,
        min_length=1,
        max_length=100,
        description="Names of the effects to try; all without it.",
    )

    @field_validator("candidates")
    @classmethod
    def _known(cls, names: list[str] | None) -> list[str] | None:
        if names is not None and not set(names) <= set(CATALOGUE):
            raise ValueError(f"the catalogue of effects has {', '.join(CATALOGUE)}")
        return None if names is None else list(dict.fromkeys(names))

    @field_validator("images")
    @classmethod
    def _not_too_many(cls, images: int, info: ValidationInfo) -> int:
        named = info.data.get("heliostats")
        count = info.data.get("max_heliostats", 1) if named is None else len(set(named))
        if count * images > MAX_STUDY_IMAGES:
            raise ValueError(
                f"{count * images} in all, {MAX_STUDY_IMAGES} at most; ask for"
                f" {MAX_STUDY_IMAGES // count} of each heliostat, or for fewer heliostats"
            )
        return images


def make_study(context: Context, payload: StudyIn) -> Result:
    """Make a study and store it, once even if the job restarts."""
    if "study" not in context.steps():
        studied = study_store(context.runtime, StudyRequest(**payload.model_dump()), context.report)
        options = payload.model_dump(mode="json")
        title, scales = (
            f"Study of job {context.lease.job_id}",
            context.runtime.settings.figure_scales,
        )
        row = study_row(studied, title, options, context.created_by, scales)
        with context.runtime.database.writing() as session:
            store.add_study(session, row)
            about = {
                "study": row.id,
                "verdict": row.verdict,
                "conclusion": row.conclusion,
                "photographs": len(studied.material.photographs),
                "skipped": row.skipped,
            }
            context.keep(session, "study", about)
    return Result(context.steps()["study"])


KIND = Kind(
    "studies", StudyIn, make_study, "Find the effect that photographs demand and the model lacks."
)
