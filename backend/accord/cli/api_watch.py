"""Whether the server's process answers: a thread of `accord up` sends it a request now and then."""

import http.client
import threading
import time
from contextlib import closing
from urllib.parse import urlsplit

#: nothing is there; the event loop says so without a thread or the database, so that waiting for these is no hang
_PATH = "/api"
#: requests in a row without a response, after which a process hangs
_UNANSWERED = 2
#: the same for a process that has not answered yet, which may be starting
_UNANSWERED_AT_START = 20


class ApiWatch:
    """Notices that the server's process is stopped or hangs.

    Only silence counts: any response is one, and so is a refused or reset connection.
    """

    def __init__(self, url: str, timeout_seconds: float) -> None:
        self.timeout_seconds = timeout_seconds
        self._address = urlsplit(url)
        self._pid = 0
        self._has_answered, self._unanswered = False, 0
        threading.Thread(target=self._run, name="api-watch", daemon=True).start()

    def hangs(self, pid: int) -> bool:
        """Whether this process, which runs now, left two requests in a row unanswered, or twenty since it started."""
        if pid != self._pid:
            self._has_answered, self._unanswered = False, 0
            self._pid = pid
        return self._unanswered >= (_UNANSWERED if self._has_answered else _UNANSWERED_AT_START)

    def _run(self) -> None:
        while True:
            pid, answered = self._pid, self._answers()
            if pid == self._pid:
                self._has_answered = self._has_answered or answered
                self._unanswered = 0 if answered else self._unanswered + 1
            if answered:
                time.sleep(self.timeout_seconds / 2)

    def _answers(self) -> bool:
        address = self._address
        connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=self.timeout_seconds)
        with closing(connection):
            try:
                connection.request("GET", _PATH)
                connection.getresponse()
            except TimeoutError:
                return False
            except (OSError, http.client.HTTPException):
                return True
            return True
