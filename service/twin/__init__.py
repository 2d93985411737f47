"""Use of the model by the service: ingest, prediction, forecasts, studies, versions, accuracy."""
