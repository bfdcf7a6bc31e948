"""accord link, accord user add: who may come in."""

from typing import Annotated

import typer

from accord.cli.options import Home, load_settings, service_url
from accord.cli.output import out, say
from accord.domain.enums import Role
from accord.services import accounts
from accord.settings import Settings
from accord.store.database import Database

user = typer.Typer(help="People and programs that may sign in.", no_args_is_help=True)


@user.callback()
def users() -> None:
    """People and programs that may sign in."""


def link(home: Home = None) -> None:
    """Print a new sign-in link for the admin. It works once."""
    settings = load_settings(home)
    database = open_migrated(settings)
    with database.transaction() as session:
        token = accounts.make_link(session, accounts.ensure_admin(session).id, settings.link_minutes)
    say(sign_in_url(settings, token))
    database.close()


@user.command("add")
def add(
    name: Annotated[str, typer.Argument(help="A name that nobody here has yet.")],
    role: Annotated[
        Role,
        typer.Option(
            help="A labeller sees clips alone, a teacher (a program) returns too, a researcher runs experiments, "
            "an admin adds users."
        ),
    ] = Role.LABELLER,
    home: Home = None,
) -> None:
    """Add a user. Prints the bearer token, for programs, and a sign-in link, for a browser."""
    settings = load_settings(home)
    database = open_migrated(settings)
    with database.transaction() as session:
        row, token = accounts.create_user(session, name, role)
        link_token = accounts.make_link(session, row.id, settings.link_minutes)
    # Plain lines: a script reads them.
    out.print(f"token {token}", markup=False)
    out.print(f"link  {sign_in_url(settings, link_token)}", markup=False)
    database.close()


def open_migrated(settings: Settings) -> Database:
    """The database of this home, with all its tables.

    Raises:
        DatabaseTooNew, DatabaseUnreachable: with what to do about it.
    """
    database = Database.open(settings.resolved_database_url)
    database.migrate()
    return database


def sign_in_url(settings: Settings, link_token: str) -> str:
    return f"{service_url(settings)}/sign-in/{link_token}"
