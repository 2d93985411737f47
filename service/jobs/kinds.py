"""Every kind of job by its name. A new kind is a file beside this one, and one line here."""

from service.jobs.field_forecasts import FleetForecastIn, forecast_field
from service.jobs.imports import ImportIn, import_allowed
from service.jobs.kind import Kind, Kinds
from service.jobs.predictions import PredictionsIn, predict_many
from service.jobs.studies import StudyIn, make_study

KINDS: Kinds = {
    kind.name: kind
    for kind in (
        Kind("predictions", PredictionsIn, predict_many, "Predict the surfaces of many heliostats."),
        Kind("forecasts", FleetForecastIn, forecast_field, "Superpose the flux of many heliostats on one receiver."),
        Kind("studies", StudyIn, make_study, "Find the effect that photographs demand and the model lacks."),
        Kind("imports", ImportIn, import_allowed, "Load a measurement folder into the store."),
    )
}
"""Every kind of job by its name."""
