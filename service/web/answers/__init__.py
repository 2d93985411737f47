"""The form of answers: representations, pages of lists, problems, the OpenAPI document."""
