"""Blobs in an object store: S3 and what speaks its protocol. Needs the extra `s3`.

Endpoint, region and credentials come from the environment variables of AWS (`AWS_ENDPOINT_URL`, `AWS_ACCESS_KEY_ID`,
...), from the files and addresses that they name, or from the machine's role.
"""

import re
import secrets
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, PermissionDeniedError, UnauthenticatedError
from obstore.store import S3Store

from accord.domain.errors import BlobMissing, BlobsNotWritable, BlobsUnreachable
from accord.store.blobs import PROBE, StoredBlob, checked_key, is_blob_key

#: The server may be away or hang: requests fail in time for a browser to try again.
_CONNECT_SECONDS = 5.0
#: of a request, or of each part of a large upload
_REQUEST_SECONDS = 15.0
_RETRIES = 3
_RETRY_SECONDS = 5.0
#: where a machine of AWS finds the credentials of its role
_MACHINE_ROLE = "169.254.169.254"


class ObjectBlobs:
    """Blobs in an object store, which writes each blob atomically."""

    def __init__(self, url: str) -> None:
        """Connects to nothing yet.

        Args:
            url: s3://bucket/prefix.

        Raises:
            BlobsNotWritable: if the URL is not valid.
        """
        self._url = url.rstrip("/")
        try:
            self._store = S3Store.from_url(
                self._url,
                client_options={
                    "allow_http": True,  # where AWS_ENDPOINT_URL says so
                    "connect_timeout": timedelta(seconds=_CONNECT_SECONDS),
                    "timeout": timedelta(seconds=_REQUEST_SECONDS),
                },
                retry_config={"max_retries": _RETRIES, "retry_timeout": timedelta(seconds=_RETRY_SECONDS)},
            )
        except (BaseError, ValueError) as error:
            raise BlobsNotWritable(
                f"Blobs cannot be stored at {url!r}: {_first_line(error)}. Set ACCORD_BLOB_URL to s3://bucket/prefix."
            ) from error

    def put(self, key: str, content: bytes) -> None:
        # Asked first, because not every server knows the condition of `create`.
        if self.exists(key):
            return
        with self._translated(), suppress(AlreadyExistsError):
            obstore.put(self._store, key, content, mode="create")

    def put_many(self, blobs: Iterable[tuple[str, bytes]]) -> None:
        for key, content in blobs:
            self.put(key, content)

    def read(self, key: str) -> bytes:
        with self._translated(key):
            return bytes(obstore.get(self._store, checked_key(key)).bytes())

    def read_range(self, key: str, start: int, stop: int) -> bytes:
        # A request for the whole blob: videos are small, and some servers answer ranges with the wrong status.
        return self.read(key)[start : max(start, stop)]

    def size(self, key: str) -> int:
        with self._translated(key):
            return obstore.head(self._store, checked_key(key))["size"]

    def signed_url(self, key: str, seconds: float) -> str | None:
        with self._translated():
            return obstore.sign(self._store, "GET", checked_key(key), timedelta(seconds=seconds))

    def exists(self, key: str) -> bool:
        try:
            self.size(key)
        except BlobMissing:
            return False
        return True

    def delete(self, key: str) -> None:
        with self._translated(), suppress(FileNotFoundError):
            obstore.delete(self._store, checked_key(key))

    def stored(self) -> Iterator[StoredBlob]:
        with self._translated():
            for batch in obstore.list(self._store):  # pyright: ignore[reportUnknownMemberType]
                for found in batch:
                    if is_blob_key(found["path"]):
                        yield StoredBlob(found["path"], found["size"], found["last_modified"])

    def is_empty(self) -> bool:
        return next(self.stored(), None) is None

    def check_writable(self) -> None:
        key = f"{PROBE}/{secrets.token_hex(8)}"
        with self._translated():
            # without `put`, whose first request gets no reason if it is refused
            obstore.put(self._store, key, b"accord")
        self.delete(key)

    @contextmanager
    def _translated(self, key: str | None = None) -> Generator[None]:
        """
        Args:
            key: of the blob that may be missing.

        Raises:
            BlobMissing, BlobsUnreachable: for what obstore raises.
        """
        try:
            yield
        except FileNotFoundError as error:
            if key is None or "<Code>NoSuchBucket" in str(error):
                raise self._no_bucket() from error
            raise BlobMissing(key) from error
        except (BaseError, OSError) as error:
            raise self._failure(error) from error

    def _failure(self, error: Exception) -> BlobsUnreachable:
        text = str(error)
        if "<Code>NoSuchBucket" in text:
            return self._no_bucket()
        if _MACHINE_ROLE in text:
            return BlobsUnreachable(
                f"There are no credentials for {self._url}. Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY."
            )
        if isinstance(error, PermissionDeniedError | UnauthenticatedError) or " 403 " in text or " 401 " in text:
            return BlobsUnreachable(
                f"{self._url} refuses these credentials ({_reason(text)}). Set AWS_ACCESS_KEY_ID and "
                "AWS_SECRET_ACCESS_KEY to those of somebody who may list, read, write and delete there."
            )
        return BlobsUnreachable(
            f"{self._url} does not answer ({_reason(text)}). Check that its server runs and that AWS_ENDPOINT_URL and "
            "AWS_REGION are right."
        )

    def _no_bucket(self) -> BlobsUnreachable:
        return BlobsUnreachable(
            f"The bucket of {self._url} does not exist. Create it, or set ACCORD_BLOB_URL to another one."
        )


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


def _reason(text: str) -> str:
    """The code of the server's answer, or the first line of the client's message."""
    code = re.search(r"<Code>(\w+)</Code>", text)
    return code[1] if code else text.partition("\n")[0]
