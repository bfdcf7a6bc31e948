"""Run the steps of a Dockerfile in folders with chroot, for machines without a container engine. Needs root.

The base image is Debian from debootstrap with Python in /usr/local, where the official images of Python have it. Steps
run in the root folder of their stage, with the network and the devices of this machine. Layers, caches and
`COPY --chown` do not exist here.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

_BASE_IMAGE = re.compile(r"python:3\.11-slim-(?P<release>\w+)")
_NETWORK_VARIABLES = (
    *("PIP_INDEX_URL", "PIP_FIND_LINKS", "NODE_EXTRA_CA_CERTS", "SSL_CERT_FILE"),
    *("https_proxy", "http_proxy", "no_proxy"),
)


@dataclass(frozen=True, slots=True)
class Instruction:
    """One instruction of a Dockerfile, for example RUN with its command."""

    name: str
    value: str

    def words(self) -> list[str]:
        """The value in exec form (a JSON array) or as words of a shell."""
        return json.loads(self.value) if self.value.startswith("[") else shlex.split(self.value)


def read_dockerfile(path: Path) -> list[Instruction]:
    """The instructions, with continued lines joined and comments left out."""
    lines = [line for line in path.read_text().splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    return [Instruction(*line.split(maxsplit=1)) for line in joined.splitlines()]


@dataclass(slots=True)
class Image:
    """The last stage, as a folder, with what containers of it start with."""

    root: Path
    environment: dict[str, str] = field(default_factory=dict)
    user: str = "root"
    folder: str = "/"
    entrypoint: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)
    health_check: list[str] = field(default_factory=list)
    stop_signal: str = "SIGTERM"

    def arguments(self, command: list[str]) -> list[str]:
        """The command that runs `command` in the image as its user, in a mount and process namespace of its own.

        The namespace ends with its first process, and the mounts with it.
        """
        inside = " && ".join(
            [
                *(f"mkdir -p {self.root}/{name}" for name in _wheel_folders()),
                *(f"mount --rbind /{name} {self.root}/{name}" for name in ("dev", "sys", *_wheel_folders())),
                f"mount -t proc proc {self.root}/proc",
                f"exec chroot --userspec={self.user} {self.root} /bin/sh -c "
                + shlex.quote(f"cd {self.folder} && exec {shlex.join(command)}"),
            ]
        )
        return ["unshare", "--mount", "--pid", "--fork", "--kill-child=SIGKILL", "/bin/sh", "-c", inside]

    def variables(self, more: Mapping[str, str] | None = None) -> dict[str, str]:
        """The environment of a container, and nothing of this process's."""
        home = "/root" if self.user == "root" else f"/home/{self.user}"
        path = {"PATH": "/usr/local/bin:/usr/local/sbin:/usr/bin:/usr/sbin:/bin:/sbin", "HOME": home}
        return path | self.environment | dict(more or {})

    def run(self, command: list[str], more: Mapping[str, str] | None = None) -> None:
        """Raises CalledProcessError, with the end of the output as a note."""
        done = subprocess.run(
            self.arguments(command),
            env=self.variables(more),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode:
            error = subprocess.CalledProcessError(done.returncode, command)
            error.add_note(done.stdout[-4000:])
            raise error


def build(dockerfile: Path, context: Path, folder: Path) -> Image:
    """Run each instruction of every stage; return the last stage."""
    ignored = [line for line in (context / ".dockerignore").read_text().splitlines() if line]
    stages: dict[str, Image] = {}
    image = Image(Path())
    arguments: dict[str, str] = {}
    for number, instruction in enumerate(read_dockerfile(dockerfile)):
        words = instruction.words()
        match instruction.name:
            case "FROM":
                image = Image(folder / f"stage-{number}", dict(_build_variables()))
                _copy_base(words[0], folder, image)
                stages[words[2] if len(words) == 3 else str(number)] = image
            case "ARG":
                arguments |= dict([instruction.value.split("=", 1)])
            case "COPY":
                _copy(words, context, stages, image, ignored)
            case "RUN":
                image.run(["/bin/sh", "-c", instruction.value], arguments)
            case _:
                _configure(image, instruction)
    for name in _build_variables():
        del image.environment[name]
    return image


def _configure(image: Image, instruction: Instruction) -> None:
    """Instructions that say what containers start with."""
    words = instruction.words()
    match instruction.name:
        case "ENV":
            image.environment |= dict(word.split("=", 1) for word in words)
        case "WORKDIR":
            image.folder = words[0]
            (image.root / words[0].lstrip("/")).mkdir(parents=True, exist_ok=True)
        case "USER":
            image.user = words[0]
        case "ENTRYPOINT":
            image.entrypoint = words
        case "CMD":
            image.command = words
        case "HEALTHCHECK":
            image.health_check = json.loads(instruction.value.partition("CMD ")[2])
        case "STOPSIGNAL":
            image.stop_signal = words[0]
        case "VOLUME" | "EXPOSE":
            pass
        case other:
            raise NotImplementedError(other)


def _wheel_folders() -> list[str]:
    """Folders of this machine in which pip finds packages, such as torch without CUDA, which is gigabytes smaller."""
    found = os.environ.get("PIP_FIND_LINKS", "").split()
    return [each.lstrip("/") for each in found if Path(each).is_absolute() and Path(each).is_dir()]


def _build_variables() -> dict[str, str]:
    """How pip and npm reach their package indexes from here."""
    found = {name: os.environ[name] for name in _NETWORK_VARIABLES if name in os.environ}
    return found | {"PIP_ROOT_USER_ACTION": "ignore", "PIP_CERT": "/etc/ssl/certs/ca-certificates.crt"}


def _copy_base(name: str, folder: Path, image: Image) -> None:
    """A copy of the base image's root folder, which is made once."""
    match = _BASE_IMAGE.fullmatch(name)
    assert match, f"{name} is not built here"
    base = Image(folder / match["release"])
    if not base.root.exists():
        new = base.root.with_suffix(".new")
        shutil.rmtree(new, ignore_errors=True)
        subprocess.run(["debootstrap", "--variant=minbase", match["release"], str(new)], check=True)
        _install_python(Image(new))
        new.rename(base.root)
    subprocess.run(["cp", "-a", "--reflink=auto", str(base.root), str(image.root)], check=True)


def _install_python(base: Image) -> None:
    quiet = {"DEBIAN_FRONTEND": "noninteractive"}
    base.run(["apt-get", "update"], quiet)
    packages = ["python3.11", "python3.11-venv", "ca-certificates"]
    base.run(["apt-get", "install", "-y", "--no-install-recommends", *packages], quiet)
    base.run(["python3.11", "-m", "venv", "/usr/local"])
    certificates = "etc/ssl/certs/ca-certificates.crt"  # those of this machine, whose network may have one of its own
    shutil.copyfile(Path("/") / certificates, base.root / certificates)
    shutil.copyfile("/etc/resolv.conf", base.root / "etc/resolv.conf")
    shutil.copyfile("/etc/hosts", base.root / "etc/hosts")


def _copy(words: list[str], context: Path, stages: Mapping[str, Image], image: Image, ignored: list[str]) -> None:
    """COPY [--from=STAGE] SOURCE... DESTINATION"""
    *sources, destination = (word for word in words if not word.startswith("--"))
    [origin] = [stages[word.removeprefix("--from=")].root for word in words if word.startswith("--from=")] or [context]
    target = image.root / (destination if destination.startswith("/") else f"{image.folder}/{destination}").lstrip("/")
    for source in sources:
        path = origin / source.lstrip("/")
        if path.is_dir():
            patterns = ignored if origin == context else []
            excluded = [f"--exclude=./{each}" if "**" not in each else f"--exclude={each[3:]}" for each in patterns]
            target.mkdir(parents=True, exist_ok=True)
            nested = [each.replace(f"./{source}/", "./") for each in excluded]
            with subprocess.Popen(["tar", "-C", path, *nested, "-c", "."], stdout=subprocess.PIPE) as packed:
                subprocess.run(["tar", "-C", target, "-x", "--no-same-owner"], stdin=packed.stdout, check=True)
        else:
            target.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)


@contextmanager
def container(image: Image, log: Path, more: Mapping[str, str] | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """The image's own command, in the network of this machine; killed at the end of the block."""
    with (
        log.open("ab") as output,
        subprocess.Popen(
            image.arguments(image.entrypoint + image.command),
            env=image.variables(more),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        ) as process,
    ):
        try:
            yield process
        finally:
            process.kill()
