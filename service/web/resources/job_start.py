"""Work that can be started: uploads for imports, and a page with what each would cost."""

from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, File, Form, Query, Request, Response, UploadFile, status
from fastapi import Path as PathParam
from fastapi.responses import HTMLResponse
from pydantic import model_validator

from service import store
from service.base.fields import FormMoment, Method, Model, Name, Text, drop_empty_fields
from service.jobs.costs import calibration_cost, count_images, import_cost, prediction_cost
from service.jobs.kinds import calibrations, imports, predictions
from service.jobs.kinds.calibrations import CalibrationIn
from service.jobs.kinds.imports import ImportIn, allowed_folder, import_root
from service.jobs.kinds.predictions import PredictionsIn
from service.jobs.uploads import (
    UploadedFolder,
    delete_upload,
    find_upload,
    list_uploads,
    receive_upload,
)
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
from service.web.responses.openapi import problems
from service.web.responses.pages import go_to, go_to_job, render
from service.web.responses.paging import Page

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
