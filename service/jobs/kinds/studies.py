"""The job `studies`: find an effect that photographs show and the model lacks."""

from service import store
from service.jobs.kind import Context, Kind, Result
from service.twin.studies.study import StudyIn, study_row, study_store


def make_study(context: Context, payload: StudyIn) -> Result:
    """Make a study and store it, once even if the job restarts."""
    if "study" not in context.steps():
        studied = study_store(context.runtime, payload, context.report)
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
