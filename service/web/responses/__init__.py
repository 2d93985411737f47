"""Responses: representations, pages of lists, problem documents, and the OpenAPI document."""
