"""What the service does with the model: ingest, predict, forecast, study, versions, accuracy."""
