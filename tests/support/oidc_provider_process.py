"""An OpenID Connect provider with one client and one person, who never has to enter a password.

`POST /person` says who that is and what is wrong with their ID token: {"claims": {...}, "id_token": {...}, "key": ...,
"error": ...}. `POST /rotate` replaces the key. Prints its URL when it is ready.
"""

import base64
import hashlib
import json
import secrets
import sys
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

from joserfc import jwt
from joserfc.jwk import OctKey, RSAKey

CLIENT_ID, CLIENT_SECRET = "accord-test", "secret-of-the-test"


class Provider(ThreadingHTTPServer):
    """The state of the provider."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.issuer = f"http://127.0.0.1:{self.server_port}"
        self.person: dict[str, Any] = {"claims": {"sub": "1"}}
        self.codes: dict[str, dict[str, str]] = {}
        self.access_tokens: dict[str, dict[str, Any]] = {}
        self.rotate()

    def rotate(self) -> None:
        self.key = RSAKey.generate_key(2048, {"kid": secrets.token_hex(4)}, private=True)

    def id_token(self, nonce: str) -> str:
        now = int(time.time())
        claims = {"iss": self.issuer, "aud": CLIENT_ID, "iat": now, "exp": now + 60, "nonce": nonce}
        claims |= self.person["claims"] | self.person.get("id_token", {})
        claims = {name: value for name, value in claims.items() if value is not None}
        kid = self.key.kid
        match self.person.get("key"):
            case "other":
                key = RSAKey.generate_key(2048, {"kid": kid}, private=True)
            case "secret":
                key = OctKey.import_key(CLIENT_SECRET.ljust(32, "."), {"kid": kid})
                return jwt.encode({"alg": "HS256", "kid": kid}, claims, key)
            case "none":
                parts = ({"alg": "none", "kid": kid}, claims)
                return ".".join(map(encoded, parts)) + "."
            case _:
                key = self.key
        return jwt.encode({"alg": "RS256", "kid": kid}, claims, key)


class Handler(BaseHTTPRequestHandler):
    """One request."""

    server: Provider

    def do_GET(self) -> None:
        url = urlsplit(self.path)
        query, issuer = dict(parse_qsl(url.query)), self.server.issuer
        match url.path:
            case "/.well-known/openid-configuration":
                endpoints = ("authorization", "token", "userinfo", "end_session")
                self.respond(
                    {f"{each}_endpoint": f"{issuer}/{each}" for each in endpoints}
                    | {"issuer": issuer, "jwks_uri": f"{issuer}/jwks"}
                    | {"id_token_signing_alg_values_supported": ["RS256", "HS256", "none"]}
                )
            case "/jwks":
                self.respond({"keys": [self.server.key.as_dict(private=False)]})
            case "/authorization":
                assert query["client_id"] == CLIENT_ID
                assert query["response_type"] == "code"
                assert query["code_challenge_method"] == "S256"
                answer = {"state": query["state"]}
                if "error" in self.server.person:
                    answer["error"] = self.server.person["error"]
                else:
                    answer["code"] = secrets.token_urlsafe(16)
                    self.server.codes[answer["code"]] = query
                self.redirect(f"{query['redirect_uri']}?{urlencode(answer)}")
            case "/userinfo":
                token = self.headers["Authorization"].removeprefix("Bearer ")
                self.respond(self.server.access_tokens[token])
            case "/end_session":
                assert query["client_id"] == CLIENT_ID
                self.redirect(query["post_logout_redirect_uri"])
            case _:
                self.respond({"error": "not_found"}, 404)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"] or 0))
        match self.path:
            case "/person":
                self.server.person = json.loads(body)
                self.respond({})
            case "/rotate":
                self.server.rotate()
                self.respond({})
            case "/token":
                self.token(dict(parse_qsl(body.decode())))

    def token(self, form: dict[str, str]) -> None:
        """Exchanges a code, once, and only for the client that it was made for."""
        asked = self.server.codes.pop(form["code"], None)
        basic = base64.b64encode(f"{CLIENT_ID}:{CLIENT_SECRET}".encode()).decode()
        digest = hashlib.sha256(form.get("code_verifier", "").encode()).digest()
        challenge = base64.urlsafe_b64encode(digest).decode().rstrip("=")
        if (
            self.headers["Authorization"] != f"Basic {basic}"
            or asked is None
            or asked["code_challenge"] != challenge
            or asked["redirect_uri"] != form["redirect_uri"]
        ):
            self.respond({"error": "invalid_grant"}, 400)
            return
        access_token = secrets.token_urlsafe(16)
        self.server.access_tokens[access_token] = self.server.person.get("userinfo", self.server.person["claims"])
        self.respond(
            {"access_token": access_token, "token_type": "Bearer", "id_token": self.server.id_token(asked["nonce"])}
        )

    def respond(self, content: dict[str, Any], status: int = 200) -> None:
        body = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def redirect(self, url: str) -> None:
        self.send_response(302)
        self.send_header("Location", url)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: the test reads the URL only."""


def encoded(part: dict[str, Any]) -> str:
    return base64.urlsafe_b64encode(json.dumps(part).encode()).decode().rstrip("=")


if __name__ == "__main__":
    server = Provider()
    print(server.issuer, flush=True)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        sys.exit(0)
