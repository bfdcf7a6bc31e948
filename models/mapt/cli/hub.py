"""The subcommands `mapt push` and `mapt pull`."""

from pathlib import Path
from typing import Annotated

import typer

from mapt import hub
from mapt.cli.output import print_line, print_paths

Repository = Annotated[
    str, typer.Argument(metavar="REPOSITORY", help="Model repository of the Hub: ORGANISATION/NAME.")
]

Private = Annotated[
    bool, typer.Option("--private", help="Make a new repository private.  [default: as the organisation sets]")
]


def push(
    path: Annotated[
        Path, typer.Argument(help="Folder of a reward model, folder of a run of `mapt train`, or a policy's file.")
    ],
    repo_id: Repository,
    *,
    private: Private = False,
) -> None:
    """Upload a reward model, a run or a policy to the Hugging Face Hub.

    The repository is created if it is missing, and gets a model card. Sign in with `hf auth login`, or set HF_TOKEN to
    a token that may write.
    """
    print_line(hub.push(path, repo_id, private=private or None))


def pull(
    repo_id: Repository,
    folder: Annotated[Path, typer.Argument(help="Folder to write; it holds no earlier version of the files.")],
    *,
    revision: Annotated[
        str | None, typer.Option(help="Branch, tag or commit.  [default: the newest commit]", show_default=False)
    ] = None,
) -> None:
    """Download a reward model, a run or a policy from the Hugging Face Hub.

    `mapt train --reward FOLDER` trains on a reward model, `mapt evaluate FOLDER` evaluates a run. A private repository
    needs HF_TOKEN or `hf auth login`.
    """
    hub.pull(repo_id, folder, revision=revision)
    print_paths(folder)
