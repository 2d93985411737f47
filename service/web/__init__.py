"""HTTP interface: the application, authentication, responses, API resources and pages."""
