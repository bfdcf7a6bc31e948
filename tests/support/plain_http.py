"""Options of httpx for the services of the tests."""

from typing import TypedDict


class HttpOptions(TypedDict):
    trust_env: bool
    verify: bool


#: Without the proxies of the environment, and without loading certificates, which takes 20 ms of CPU time per client.
PLAIN_HTTP: HttpOptions = {"trust_env": False, "verify": False}
