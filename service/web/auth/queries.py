"""Query parameters: a route accepts those that it documents, and no others."""

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel


def query_names(dependant: Dependant) -> list[str]:
    """Names of the query parameters that a route and its dependencies accept."""
    names = [name for inner in dependant.dependencies for name in query_names(inner)]
    for parameter in dependant.query_params:
        kind = parameter.field_info.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            names += [field.alias or name for name, field in kind.model_fields.items()]
        else:
            names.append(parameter.alias)
    return list(dict.fromkeys(names))


async def require_known_query(request: Request) -> None:
    """Refuse query parameters that the route does not know.

    Otherwise, a misspelled filter would return the unfiltered list.
    """
    known = query_names(request.scope["route"].dependant)
    unknown = [name for name in request.query_params if name not in known]
    if unknown:
        listed = f"known are {', '.join(known)}" if known else "this path takes none"
        message = ValueError(f"is not a parameter of this path; {listed}")
        raise RequestValidationError(
            [
                {
                    "type": "value_error",
                    "loc": ("query", name),
                    "msg": str(message),
                    "ctx": {"error": message},
                }
                for name in unknown
            ]
        )
