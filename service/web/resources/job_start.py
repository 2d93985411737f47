"""Work that can be started: uploads for imports, and a page with what each would cost.

Costs come from the durations of earlier jobs of the kind.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import median
from typing import Annotated

from fastapi import APIRouter, Depends, File, Form, Query, Request, Response, UploadFile, status
from fastapi import Path as PathParam
from fastapi.responses import HTMLResponse
from pydantic import model_validator
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.effects import CATALOGUE
from service import store
from service.base.fields import FormMoment, Method, Model, Name, Text, drop_empty_fields
from service.jobs.kinds import calibrations, imports, predictions
from service.jobs.kinds.calibrations import CalibrationIn
from service.jobs.kinds.imports import ImportIn, allowed_folder, import_root
from service.jobs.kinds.predictions import EACH_S, PredictionsIn
from service.jobs.uploads import (
    UploadedFolder,
    delete_upload,
    find_upload,
    list_uploads,
    receive_upload,
)
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow, MeasurementRow
from service.twin.runtime import Runtime
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    IdentityDep,
    RuntimeDep,
    ZoneDep,
    accept_archive,
)
from service.web.responses.lists import Page
from service.web.responses.openapi import problems
from service.web.responses.pages import go_to, go_to_job, render

# Newest finished jobs of a kind that are read.
_READ_JOBS = 10

# Stated durations without earlier jobs [s]: of a heliostat's mount, of a photograph's import, and
# of one effect tried on a photograph.
_CALIBRATION_S, _IMPORT_S, _TRIAL_S = 1.0, 0.5, 0.15

_IMAGES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"))
_MOST_FILES = 100_000


@dataclass(frozen=True)
class Cost:
    """Expected cost: ``count`` units of ``each_s`` [s], the median of ``n_jobs`` earlier jobs.

    Without earlier jobs ``each_s`` is a stated rate.
    """

    count: int
    each_s: float
    n_jobs: int

    @property
    def total_s(self) -> float:
        """Expected duration [s]."""
        return self.count * self.each_s


def _cost(
    session: Session, kind: str, count: int, stated_s: float, units: Callable[[JobRow], int]
) -> Cost:
    """The cost of ``count`` units; ``units`` counts those of an earlier job."""
    query = select(JobRow).where(JobRow.kind == kind, JobRow.state == "done")
    rates = [
        (row.finished_at - row.attempted_at).total_seconds() / n
        for row in session.scalars(query.order_by(JobRow.id.desc()).limit(_READ_JOBS))
        if row.finished_at and row.attempted_at and row.attempts == 1 and (n := units(row))
    ]
    return Cost(count, median(rates) if rates else stated_s, len(rates))


def _results(row: JobRow, part: str) -> int:
    return len((row.result or {}).get(part, ()))


def prediction_cost(session: Session, heliostat: str | None, method: Method) -> Cost:
    """The cost of surfaces of a heliostat, or of all that have an accepted photograph."""
    photographed = select(func.count(func.distinct(MeasurementRow.heliostat_id)))
    count = session.scalars(photographed.where(MeasurementRow.accepted)).one()
    return _cost(
        session,
        "predictions",
        count if heliostat is None else 1,
        EACH_S[method],
        lambda row: _results(row, "surfaces") * (row.payload.get("method") == method),
    )


def calibration_cost(session: Session, heliostat: str | None) -> Cost:
    """The cost of the mounts of a heliostat, or of all whose photographs have motor positions."""
    driven = select(func.count(func.distinct(MeasurementRow.heliostat_id)))
    driven = driven.where(MeasurementRow.motor_axis_1.is_not(None))
    if heliostat is not None:
        driven = driven.join(HeliostatRow).where(HeliostatRow.name == heliostat)
    count = session.scalars(driven).one()
    return _cost(
        session, "calibrations", count, _CALIBRATION_S, lambda row: _results(row, "mounts")
    )


def study_cost(session: Session, n_photographs: int, effects: Sequence[str] | None) -> Cost:
    """The cost of trying effects, by default all, on photographs."""

    def n_trials(n_photographs: int, effects: Sequence[str] | None) -> int:
        return n_photographs * len(CATALOGUE if effects is None else effects)

    return _cost(
        session,
        "studies",
        n_trials(n_photographs, effects),
        _TRIAL_S,
        lambda row: n_trials(
            (row.result or {}).get("photographs", 0), row.payload.get("candidates")
        ),
    )


def count_images(folder: Path) -> int:
    """The number of images of a folder; at most 100,000 files are counted."""
    files = islice(folder.rglob("*"), _MOST_FILES)
    return sum(path.suffix.lower() in _IMAGES for path in files)


def import_cost(session: Session, n_images: int) -> Cost:
    """The cost of the images of a folder."""
    return _cost(
        session,
        "imports",
        n_images,
        _IMPORT_S,
        lambda row: (row.result or {}).get("counts", {}).get("images new", 0),
    )


router = APIRouter(prefix="/jobs", tags=["jobs"])
pages = APIRouter(include_in_schema=False)

_MOST_FOLDERS = 200


class StartQuery(Model):
    """What the page computes costs of: one ``heliostat`` or all, a method, and a folder.

    The folder may be an ``uploaded`` one.
    """

    heliostat: Name | None = None
    method: Method = "refined"
    folder: Text | None = None
    uploaded: bool = False

    _filled = model_validator(mode="before")(drop_empty_fields)

    @property
    def heliostats(self) -> list[str] | None:
        """The heliostats of a job's payload; None for all."""
        return None if self.heliostat is None else [self.heliostat]


class CalibrationForm(Model):
    """The form that requests mounts, from photographs of a time range."""

    heliostat: Name | None = None
    since: FormMoment | None = None
    until: FormMoment | None = None

    _filled = model_validator(mode="before")(drop_empty_fields)


def _folders(root: Path | None) -> list[str]:
    """Folders that may be imported, the first of them."""
    if root is None or not root.is_dir():
        return []
    return [".", *sorted(path.name for path in root.iterdir() if path.is_dir())][:_MOST_FOLDERS]


@router.post(
    "/imports/uploads",
    status_code=status.HTTP_201_CREATED,
    responses=problems(413, 415, 429, 507),
    dependencies=[OPERATE, Depends(accept_archive), COMPUTE_SLOT],
)
def post_import_upload(
    file: Annotated[UploadFile, File(description="ZIP file of a measurement folder.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> UploadedFolder:
    """Upload a measurement folder for an import.

    `POST /v1/jobs/imports` imports it, with its `folder` and `uploaded`. It is deleted when its
    import has ended, or after a day without one.
    """
    return receive_upload(runtime, file.file, file.filename or "", identity.name)


@router.get("/imports/uploads", responses=problems(), dependencies=[READ])
def list_import_uploads(runtime: RuntimeDep) -> Page[UploadedFolder]:
    """List the uploaded measurement folders."""
    return Page(items=list_uploads(runtime), next=None)


@router.delete(
    "/imports/uploads/{name}",
    status_code=status.HTTP_204_NO_CONTENT,
    responses=problems(404, 409),
    dependencies=[OPERATE],
)
def delete_import_upload(
    name: Annotated[Text, PathParam(description="Name of the upload.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> None:
    """Delete an uploaded measurement folder, unless a job is to import it."""
    delete_upload(runtime, name, identity.name)


def start_costs(runtime: Runtime, query: StartQuery) -> dict[str, object]:
    """Expected costs of work; NotFoundError if its heliostat or folder is not stored."""
    settings = runtime.settings
    upload = n_images = None
    if query.folder is not None and query.uploaded:
        upload = find_upload(settings, query.folder)
        n_images = upload.n_images
    elif query.folder is not None:
        n_images = count_images(allowed_folder(import_root(settings), query.folder))
    with runtime.database.reading() as session:
        if query.heliostat is not None:
            store.get_heliostat(session, query.heliostat)
        return {
            "upload": upload,
            "prediction": prediction_cost(session, query.heliostat, query.method),
            "calibration": calibration_cost(session, query.heliostat),
            "importing": None if n_images is None else import_cost(session, n_images),
        }


@pages.get("/jobs/start", dependencies=[READ])
def get_start_page(
    request: Request, query: Annotated[StartQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """Predictions, calibration, import and uploads, each with its expected cost."""
    settings = runtime.settings
    return render(
        request,
        "job_start.html",
        query=query,
        **start_costs(runtime, query),
        uploads=list_uploads(runtime),
        folders=_folders(settings.import_root),
        limits=(settings.max_body_bytes_of_key, settings.max_unpacked_bytes),
    )


@pages.post("/jobs/predictions", dependencies=[OPERATE])
def post_predictions_form(
    form: Annotated[StartQuery, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Enqueue predictions, and go to the page of the job."""
    payload = PredictionsIn(heliostats=form.heliostats, method=form.method)
    return go_to_job(runtime, predictions.KIND, payload, identity)


@pages.post("/jobs/calibrations", dependencies=[OPERATE])
def post_calibrations_form(
    form: Annotated[CalibrationForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
    zone: ZoneDep,
) -> Response:
    """Enqueue a calibration, and go to the page of the job."""
    form = form.in_utc(zone)
    names = None if form.heliostat is None else [form.heliostat]
    payload = CalibrationIn(heliostats=names, since=form.since, until=form.until)
    return go_to_job(runtime, calibrations.KIND, payload, identity)


@pages.post("/jobs/imports", dependencies=[OPERATE])
def post_imports_form(
    form: Annotated[ImportIn, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Enqueue the import of a folder, and go to the page of the job. An upload has one job."""
    if not form.uploaded:
        allowed_folder(import_root(runtime.settings), form.folder)
    return go_to_job(runtime, imports.KIND, form, identity)


@pages.post("/jobs/imports/upload", dependencies=[OPERATE, Depends(accept_archive), COMPUTE_SLOT])
def post_upload_form(
    file: Annotated[UploadFile, File()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Unpack and check a ZIP file, and show what its import would cost."""
    upload = post_import_upload(file, runtime, identity)
    return go_to(f"/jobs/start?folder={upload.folder}&uploaded=true#imports")


@pages.post("/jobs/imports/uploads/{name}/delete", dependencies=[OPERATE])
def post_delete_upload_form(name: Text, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Delete an upload."""
    delete_import_upload(name, runtime, identity)
    return go_to("/jobs/start#imports")
