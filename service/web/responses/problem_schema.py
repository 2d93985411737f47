"""Schema of problem documents (RFC 9457)."""

from pydantic import BaseModel, Field


class FieldProblem(BaseModel):
    """The error in one field of the request."""

    field: str = Field(description="Path of the field.", examples=["sun.elevation_deg"])
    message: str = Field(description="What is wrong.", examples=["must be 90 or less"])


class Problem(BaseModel):
    """An error (RFC 9457)."""

    type: str = Field(
        description="Stable name of what is wrong; the guide lists all of them.",
        examples=["urn:heliotwin:problem:invalid"],
    )
    title: str = Field(description="Name of the status.", examples=["Unprocessable Content"])
    status: int = Field(description="The HTTP status.", examples=[422])
    detail: str = Field(
        description="What is wrong, and what to do.",
        examples=["sun.elevation_deg: must be 90 or less"],
    )
    instance: str = Field(description="Path of the request.", examples=["/v1/forecasts"])
    request_id: str = Field(
        description="Quote it when reporting a fault; it is in the service's log."
    )
    errors: list[FieldProblem] | None = Field(
        default=None, description="Every field at fault, of a request that is invalid (422)."
    )
    offered: list[str] | None = Field(
        default=None, description="Acceptable media types, where none was acceptable."
    )
