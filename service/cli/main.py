"""The command ``heliotwin``."""

import sys
from typing import Any

import typer
from pydantic import ValidationError
from typer.core import TyperGroup

from model.errors import InvalidInputError, ModelError
from service.base.discovery import modules_of
from service.base.faults import ServiceError


class _Group(TyperGroup):
    """Says what is wrong with an option in one line, as `main` does of all bad input, and not in a box."""

    def invoke(self, ctx: Any) -> Any:
        """Run the verb."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            said = error.format_message()
            if error.param is not None and error.message:  # there is none for what is missing
                said = f"{error.param.opts[0]} must be valid: {error.message.removeprefix('Value error, ')}"
            raise InvalidInputError(" ".join(said.split())) from None


app = typer.Typer(
    name="heliotwin",
    cls=_Group,
    help="From a solar tower's target photographs to mirror surfaces and flux forecasts.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


for _group in modules_of("service.cli.verbs"):
    app.add_typer(_group.app)


def main() -> None:
    """Run the command; bad input ends with exit code 2 and one line, other failures of the model with 1."""
    try:
        app()
    except InvalidInputError as error:
        _fail(error, 2)
    except ValidationError as error:
        first = error.errors()[0]
        _fail(f"setting {'.'.join(map(str, first['loc'])) or 'combination'}: {first['msg']}", 2)
    except (ModelError, ServiceError, OSError) as error:
        _fail(error, 1)


def _fail(error: object, code: int) -> None:
    typer.echo(f"heliotwin: {error}", err=True)
    sys.exit(code)


if __name__ == "__main__":
    main()
