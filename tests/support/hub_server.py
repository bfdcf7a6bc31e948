"""A stand-in for the Hugging Face Hub: the part of its HTTP API that pushing to and pulling from a model needs."""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

TOKEN = "hf_of_the_test"


@dataclass
class Repository:
    """A model repository; every commit keeps all its files."""

    private: bool = False
    #: files of each commit by path, by commit id
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    head: str = ""

    def commit(self, changed: dict[str, bytes]) -> str:
        files = {**self.commits.get(self.head, {}), **changed}
        self.head = hashlib.sha1(repr((self.head, sorted(files.items()))).encode()).hexdigest()
        self.commits[self.head] = files
        return self.head

    def at(self, revision: str) -> str | None:
        found = self.head if revision == "main" else revision
        return found if found in self.commits else None


class HubServer(ThreadingHTTPServer):
    """Listens on a free port of this machine. `failing` makes every request fail with this status."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repositories: dict[str, Repository] = {}
        self.uploaded: dict[str, bytes] = {}
        self.failing: int | None = None
        self.url = f"http://127.0.0.1:{self.server_port}"


@contextmanager
def hub_server() -> Generator[HubServer]:
    server = HubServer()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: HubServer

    def handle_any(self) -> None:
        length = int(self.headers.get("Content-Length") or 0)
        body, path = self.rfile.read(length), unquote(urlsplit(self.path).path)
        if self.server.failing is not None:
            return self._fail(self.server.failing, "Maintenance")
        for method, pattern, answer in _ROUTES:
            if method == self.command.replace("HEAD", "GET") and (found := re.fullmatch(pattern, path)):
                return answer(self, body, **found.groupdict())
        return self._fail(404, f"The stand-in has no {self.command} {path}")

    do_GET = do_HEAD = do_POST = do_PUT = handle_any

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def create(self, body: bytes) -> None:
        wanted = json.loads(body)
        name = f"{wanted['organization']}/{wanted['name']}"
        if not self._may_write():
            return self._fail(401, "Invalid username or password.")
        if name in self.server.repositories:
            return self._json({"url": f"{self.server.url}/{name}", "error": "It exists"}, 409)
        self.server.repositories[name] = Repository(private=wanted.get("visibility") == "private")
        self.server.repositories[name].commit({".gitattributes": b"*.safetensors filter=lfs\n"})
        return self._json({"url": f"{self.server.url}/{name}", "name": name})

    def preupload(self, body: bytes, repo: str, revision: str) -> None:
        large = lambda path: path.endswith(".safetensors")  # noqa: E731
        files = [
            {"path": file["path"], "uploadMode": "lfs" if large(file["path"]) else "regular", "shouldIgnore": False}
            for file in json.loads(body)["files"]
        ]
        self._json({"files": files})

    def lfs_batch(self, body: bytes, repo: str) -> None:
        objects = [
            {**wanted, "actions": {"upload": {"href": f"{self.server.url}/lfs/{wanted['oid']}"}}}
            for wanted in json.loads(body)["objects"]
        ]
        self._json({"transfer": "basic", "objects": objects})

    def lfs_upload(self, body: bytes, oid: str) -> None:
        if hashlib.sha256(body).hexdigest() != oid:
            return self._fail(400, "The upload is damaged")
        self.server.uploaded[oid] = body
        return self._json({})

    def commit(self, body: bytes, repo: str, revision: str) -> None:
        if not self._may_write():
            return self._fail(403, "This token may not write.")
        changed: dict[str, bytes] = {}
        for line in body.splitlines():
            item = json.loads(line)
            if item["key"] == "file":
                changed[item["value"]["path"]] = base64.b64decode(item["value"]["content"])
            elif item["key"] == "lfsFile":
                changed[item["value"]["path"]] = self.server.uploaded[item["value"]["oid"]]
        commit = self.server.repositories[repo].commit(changed)
        return self._json({"commitUrl": f"{self.server.url}/{repo}/commit/{commit}", "commitOid": commit})

    def validate(self, body: bytes) -> None:
        self._json({"errors": [], "warnings": []})

    def info(self, body: bytes, repo: str, revision: str = "main") -> None:
        if (found := self._found(repo, revision)) is not None:
            self._json({"_id": "1", "id": repo, "sha": found[1], "siblings": []})

    def tree(self, body: bytes, repo: str, revision: str) -> None:
        if (found := self._found(repo, revision)) is not None:
            files = found[0].commits[found[1]]
            self._json(
                [
                    {"type": "file", "path": path, "size": len(content), "oid": hashlib.sha1(content).hexdigest()}
                    for path, content in files.items()
                ]
            )

    def resolve(self, body: bytes, repo: str, revision: str, path: str) -> None:
        if (found := self._found(repo, revision)) is not None:
            content = found[0].commits[found[1]][path]
            self._send(200, content, {"ETag": f'"{hashlib.sha1(content).hexdigest()}"', "X-Repo-Commit": found[1]})

    def _found(self, repo: str, revision: str) -> tuple[Repository, str] | None:
        repository = self.server.repositories.get(repo)
        if repository is None or (repository.private and not self._may_write()):
            self._fail(404, "Repository not found", "RepoNotFound")
            return None
        commit = repository.at(revision)
        if commit is None:
            self._fail(404, "Invalid rev id", "RevisionNotFound")
            return None
        return repository, commit

    def _may_write(self) -> bool:
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def _json(self, value: object, status: int = 200) -> None:
        self._send(status, json.dumps(value).encode(), {"Content-Type": "application/json"})

    def _fail(self, status: int, message: str, code: str = "") -> None:
        self._send(status, json.dumps({"error": message}).encode(), {"X-Error-Message": message, "X-Error-Code": code})

    def _send(self, status: int, content: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)


_REPO = r"(?P<repo>[^/]+/[^/]+)"
_ROUTES = [
    ("POST", "/api/repos/create", _Handler.create),
    ("POST", "/api/validate-yaml", _Handler.validate),
    ("POST", f"/api/models/{_REPO}/preupload/(?P<revision>[^/]+)", _Handler.preupload),
    ("POST", rf"/{_REPO}\.git/info/lfs/objects/batch", _Handler.lfs_batch),
    ("PUT", "/lfs/(?P<oid>[^/]+)", _Handler.lfs_upload),
    ("POST", f"/api/models/{_REPO}/commit/(?P<revision>[^/]+)", _Handler.commit),
    ("GET", f"/api/models/{_REPO}", _Handler.info),
    ("GET", f"/api/models/{_REPO}/revision/(?P<revision>[^/]+)", _Handler.info),
    ("GET", f"/api/models/{_REPO}/tree/(?P<revision>[^/]+)", _Handler.tree),
    ("GET", f"/{_REPO}/resolve/(?P<revision>[^/]+)/(?P<path>.+)", _Handler.resolve),
]
