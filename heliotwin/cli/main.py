"""The command ``heliotwin``."""

import sys
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any

import typer
from pydantic import ValidationError
from typer.core import TyperGroup

from model.errors import InvalidInputError, ModelError
from service.base.discovery import modules_of
from service.base.errors import ServiceError
from service.base.validation import format_validation_error


class _Group(TyperGroup):
    """Reports an invalid option in one line, without typer's frame.

    `main` does the same for all bad input.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the verb."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            said = error.format_message()
            if error.param is not None and error.message:  # a missing option has no message
                said = (
                    f"{error.param.opts[0]} must be valid:"
                    f" {error.message.removeprefix('Value error, ')}"
                )
            raise InvalidInputError(" ".join(said.split())) from None


def _say_version(is_asked: bool) -> None:
    if is_asked:
        try:
            typer.echo(f"heliotwin {version('heliotwin')}")
        except PackageNotFoundError:
            typer.echo("heliotwin, not installed")
        raise typer.Exit


def _options(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_say_version, is_eager=True, help="Print the version and end."
        ),
    ] = False,
) -> None:
    """Options before the verb; the help text is that of `app`."""


app = typer.Typer(
    name="heliotwin",
    cls=_Group,
    help="From a solar tower's target photographs to mirror surfaces and flux forecasts.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # otherwise rich drops units, such as [m], as markup
    context_settings={"help_option_names": ["-h", "--help"]},
    callback=_options,
)


for _group in modules_of("heliotwin.cli.verbs"):
    app.add_typer(_group.app)


def main() -> None:
    """Run the command.

    Bad input ends with exit code 2 and one line. Other failures, such as database errors, end with
    1.
    """
    try:
        app()
    except InvalidInputError as error:
        _fail(error, 2)
    except ValidationError as error:
        _fail(f"setting {format_validation_error(error, 'combination')}", 2)
    except (ModelError, ServiceError, OSError) as error:
        _fail(error, 1)
    except _database_errors() as error:
        _fail(
            "the database:"
            f" {' '.join(str(getattr(error, 'orig', None) or error).split())[:_LONGEST]}",
            1,
        )


# Maximum length of a database error message.
_LONGEST = 300


def _database_errors() -> tuple[type[Exception], ...]:
    """Error classes of SQLAlchemy and Alembic, if the verb loaded them.

    Importing them here would slow down all other verbs.
    """
    known = {"sqlalchemy.exc": "SQLAlchemyError", "alembic.util.exc": "CommandError"}
    return tuple(
        getattr(sys.modules[module], name)
        for module, name in known.items()
        if module in sys.modules
    )


def _fail(error: object, code: int) -> None:
    typer.echo(f"heliotwin: {error}", err=True)
    sys.exit(code)


if __name__ == "__main__":
    main()
