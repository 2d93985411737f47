"""Page of the work that can be started, with what each would cost before it starts."""

from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, File, Form, Query, Request, Response, UploadFile
from fastapi.responses import HTMLResponse
from pydantic import model_validator

from service import store
from service.base.fields import FormMoment, Method, Model, Name, Text, drop_empty_fields
from service.jobs.costs import calibration_cost, count_images, import_cost, prediction_cost
from service.jobs.kinds import calibrations, imports, predictions
from service.jobs.kinds.calibrations import CalibrationIn
from service.jobs.kinds.imports import ImportIn, allowed_folder, import_root
from service.jobs.kinds.predictions import PredictionsIn
from service.jobs.uploads import delete_upload, find_upload, list_uploads, receive_upload
from service.twin.forecasts.aim_sources import plant_time_zone
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    IdentityDep,
    RuntimeDep,
    accept_archive,
)
from service.web.responses.pages import go_to, go_to_job, render

router = APIRouter(include_in_schema=False, prefix="/jobs")

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


@router.get("/start", dependencies=[READ])
def get_start_page(
    request: Request, query: Annotated[StartQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """Predictions, calibration, import and uploads, each with its expected cost."""
    settings = runtime.settings
    upload = n_images = None
    if query.folder is not None and query.uploaded:
        upload = find_upload(settings, query.folder)
        n_images = upload.n_images
    elif query.folder is not None:
        n_images = count_images(allowed_folder(import_root(settings), query.folder))
    uploads = list_uploads(runtime)
    with runtime.database.reading() as session:
        if query.heliostat is not None:
            store.get_heliostat(session, query.heliostat)
        return render(
            request,
            "job_start.html",
            query=query,
            prediction=prediction_cost(session, query.heliostat, query.method),
            calibration=calibration_cost(session, query.heliostat),
            importing=None if n_images is None else import_cost(session, n_images),
            upload=upload,
            uploads=uploads,
            folders=_folders(settings.import_root),
            limits=(settings.max_body_bytes_of_key, settings.max_unpacked_bytes),
        )


@router.post("/predictions", dependencies=[OPERATE])
def post_predictions_form(
    form: Annotated[StartQuery, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Enqueue predictions, and go to the page of the job."""
    payload = PredictionsIn(heliostats=form.heliostats, method=form.method)
    return go_to_job(runtime, predictions.KIND, payload, identity)


@router.post("/calibrations", dependencies=[OPERATE])
def post_calibrations_form(
    form: Annotated[CalibrationForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Enqueue a calibration, and go to the page of the job."""
    with runtime.database.reading() as session:
        form = form.in_utc(plant_time_zone(session, runtime.settings.time_zone))
    names = None if form.heliostat is None else [form.heliostat]
    payload = CalibrationIn(heliostats=names, since=form.since, until=form.until)
    return go_to_job(runtime, calibrations.KIND, payload, identity)


@router.post("/imports", dependencies=[OPERATE])
def post_imports_form(
    form: Annotated[ImportIn, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Enqueue the import of a folder, and go to the page of the job. An upload has one job."""
    if not form.uploaded:
        allowed_folder(import_root(runtime.settings), form.folder)
    return go_to_job(runtime, imports.KIND, form, identity)


@router.post("/imports/upload", dependencies=[OPERATE, Depends(accept_archive), COMPUTE_SLOT])
def post_upload_form(
    file: Annotated[UploadFile, File()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Unpack and check a ZIP file, and show what its import would cost."""
    upload = receive_upload(runtime, file.file, file.filename or "", identity.name)
    return go_to(f"/jobs/start?folder={upload.folder}&uploaded=true#imports")


@router.post("/imports/uploads/{name}/delete", dependencies=[OPERATE])
def post_delete_upload_form(name: Text, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Delete an upload."""
    delete_upload(runtime, name, identity.name)
    return go_to("/jobs/start#imports")
