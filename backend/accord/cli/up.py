"""accord up: the service on this machine, one parent and its processes."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from accord.cli.options import Home, address_file, load_settings, url_of
from accord.cli.output import note, on_terminal, out, say
from accord.cli.start import Ready, create_example, prepare, sign_in_link
from accord.cli.watch import Watch
from accord.settings import Settings
from accord.workers.runner import Stop, follow_parent
from accord.workers.supervisor import ChildSpec, Supervisor
from mapt.processes import PATIENT_THREADS

#: how often the supervisor looks after its children
_TICK_SECONDS = 0.2
#: frames may come late, labels and updates should not
_RENDER_NICE = 5


def up(
    *,
    home: Home = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.  [default: 127.0.0.1]")] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes a free one.  [default: 8000]")
    ] = None,
    example: Annotated[
        bool, typer.Option(help="Make an example experiment at the first start, so that there is something to label.")
    ] = True,
    parent: Annotated[int, typer.Option(hidden=True, help="Pid to end with; 0 for none.")] = 0,
) -> None:
    """Start the service: the page, the API and the workers. Ctrl-C ends it."""
    stop = Stop()
    stop.install()
    follow_parent(parent)
    ready = prepare(load_settings(home, host, port))
    try:
        announce(ready, example)
        _serve(ready, stop)
    finally:
        address_file(ready.settings).unlink(missing_ok=True)
        ready.listener.close()
        ready.database.close()


def announce(ready: Ready, example: bool) -> None:
    """Print where to go, and leave the address for the other commands."""
    if example:
        create_example(ready.database)
    link = sign_in_link(ready)
    address_file(ready.settings).write_text(url_of(ready.settings.host, ready.settings.port) + "\n")
    say("[bold]Accord[/bold] is starting. Open this link to sign in:")
    out.print(f"\n  {link}\n", markup=False)
    say("[dim]It works once; `accord link` prints a new one. Ctrl-C ends Accord.[/dim]")


def _serve(ready: Ready, stop: Stop) -> None:
    watch, specs = Watch(ready.database), child_specs(ready)
    watch.begin(specs)
    supervisor = Supervisor(specs, ready.settings.home / "logs", watch.died)
    status = out.status("starting", refresh_per_second=2) if on_terminal() else None
    try:
        if status:
            status.start()
        while not stop.wait(_TICK_SECONDS):
            supervisor.tick()
            line = watch.look()
            if status and line:
                status.update(escape(line))
    finally:
        if status:
            status.stop()
        note("accord", "stopping; Ctrl-C again kills what is left")
        killed = supervisor.shutdown(stop)
        note("accord", f"stopped; killed: {', '.join(killed)}" if killed else "stopped")


def child_specs(ready: Ready) -> list[ChildSpec]:
    """The API and the workers, as the settings ask for them."""
    settings, environment = ready.settings, environment_of(ready.settings)
    api = ChildSpec(
        "api",
        ("accord.cli.serve", "--fd", str(ready.listener.fileno())),
        environment=environment | {"OMP_NUM_THREADS": "1"},
        descriptors=(ready.listener.fileno(),),
    )
    counts = {"policy": settings.policy_workers, "reward": settings.reward_workers, "render": settings.render_workers}
    threads = {"policy": settings.torch_threads, "reward": settings.torch_threads, "render": 1}
    workers = [
        ChildSpec(
            f"{role}-{slot}",
            (f"accord.workers.{role}_worker", "--slot", str(slot)),
            role=role,
            environment=environment | PATIENT_THREADS | {"OMP_NUM_THREADS": str(threads[role])},
            nice=_RENDER_NICE if role == "render" else 0,
        )
        for role, count in counts.items()
        for slot in range(count)
    ]
    return [api, *workers]


def environment_of(settings: Settings) -> dict[str, str]:
    """The settings as variables, for a child to read back; folders absolute."""
    values = settings.model_dump() | {"home": settings.home.resolve()}
    return {f"ACCORD_{name.upper()}": str(Path(value) if name == "home" else value) for name, value in values.items()}
