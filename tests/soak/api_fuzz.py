"""Random requests of every role to every operation of the REST API, made by Schemathesis from the OpenAPI document.

No request may fail with 500 or above, and every response must have a status, content type and content that the document
names. Half of the time, the ids in paths are those of stored rows; otherwise they are random. Schemathesis is no
dependency of the project:

    python3 -m venv /tmp/schemathesis && /tmp/schemathesis/bin/pip install schemathesis==4.32.5
    python tests/soak/api_fuzz.py --schemathesis /tmp/schemathesis/bin/schemathesis [--seconds 60] [--roles admin,...]
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from sqlalchemy import select

from accord.api.openapi import document
from accord.domain.enums import Role
from accord.services import shares
from accord.store.tables import ClipRow
from support.api_process import running_server
from support.sample_experiments import SampleExperiment, create_sample, user
from support.stores import Stores, open_stores

CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_schema_conformance",
)
#: an endless stream, uploads, what ends the token that is used, and redirects to a provider that does not exist
EXCLUDED = r"/(events|import|sign-out|revoke|oidc.*|tokens/\{token_id\})$"
#: what ends the experiment whose id is used; DELETE does too
ENDING = r"/(cancel|archive)$"
ANYONE = "anyone"


def ids(stores: Stores, sample: SampleExperiment) -> dict[str, str]:
    """Parameter of paths -> id of a stored row."""
    with stores.database.transaction() as session:
        somebody, _ = user(session, "somebody")
        share, _ = shares.create(session, sample.experiment.id, sample.owner.id, days=1)
        clip = session.scalars(select(ClipRow.id)).first()
    assert clip is not None
    return {
        "experiment_id": sample.experiment.id,
        "query_id": sample.query_ids[0],
        "segment_id": sample.segment_ids[0],
        "user_id": somebody.id,
        "share_id": share.id,
        "clip_id": clip,
    }


def fuzz(command: str, url: str, folder: Path, token: str, stored: dict[str, str], seconds: float) -> str:
    """Run Schemathesis; return its report of failures, empty if there are none."""
    (folder / "openapi.json").write_text(document())
    parameters = "".join(f'"path.{name}" = {json.dumps(value)}\n' for name, value in stored.items())
    (folder / "schemathesis.toml").write_text(f"[parameters]\n{parameters}" if stored else "")
    arguments = [
        command,
        *("--config-file", str(folder / "schemathesis.toml")),
        *("run", str(folder / "openapi.json"), "--url", url),
        *("--checks", ",".join(CHECKS), "--phases", "examples,coverage,fuzzing", "--continue-on-failure"),
        *("--max-time", str(int(seconds)), "--request-timeout", "30", "--suppress-health-check", "all"),
        *(
            "--exclude-path-regex",
            f"{EXCLUDED}|{ENDING}" if stored else EXCLUDED,
            "--warnings",
            "off",
            "--no-color",
            "--generation-database",
            "none",
        ),
        *(("--exclude-method", "DELETE") if stored else ()),
        *(("--header", f"Authorization: Bearer {token}") if token else ()),
    ]
    done = subprocess.run(arguments, cwd=folder, capture_output=True, text=True, check=False)
    summary = done.stdout.partition("= SUMMARY =")[2] or done.stdout[-2000:] + done.stderr[-2000:]
    print(re.sub(r"\n{2,}", "\n", summary.strip(" =\n")), flush=True)
    return "" if done.returncode == 0 else done.stdout


def documented() -> set[tuple[str, str, str]]:
    """Method, path and status of every documented response of the operations that are tested."""
    return {
        (method.upper(), path.removeprefix("/api/v1"), status)
        for path, methods in json.loads(document())["paths"].items()
        for method, operation in methods.items()
        for status in operation["responses"]
        if status.isdigit() and not re.search(EXCLUDED, path)
    }


def answers(log: str) -> set[tuple[str, str, str]]:
    """Method, route and status of every request in a log of JSON lines."""
    lines = [json.loads(line) for line in log.splitlines() if line.startswith("{")]
    return {(line["method"], line["route"], str(line["status"])) for line in lines if "status" in line}


def main() -> int:
    roles = [*(role.value for role in Role), ANYONE]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--schemathesis", default="schemathesis", help="the command")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each role")
    parser.add_argument("--roles", default=",".join(roles))
    options = parser.parse_args()
    failures: dict[str, str] = {}
    answered: set[tuple[str, str, str]] = set()
    for role in options.roles.split(","):
        with (
            tempfile.TemporaryDirectory(prefix="accord-soak-") as name,
            open_stores(Path(name)) as stores,
        ):
            folder = Path(name)
            sample = create_sample(stores.database, stores.blobs)
            stored = ids(stores, sample)
            token = ""
            if role != ANYONE:
                with stores.database.transaction() as session:
                    token = user(session, "fuzzer", Role(role))[1]
            environment = {
                "ACCORD_FAILED_SIGN_INS_PER_MINUTE": "1000000",
                "ACCORD_LOG_REQUESTS": "true",
                "ACCORD_LOG_FORMAT": "json",
            }
            with running_server(folder, environment) as server:
                for rows in (stored, {}):
                    print(f"=== {role}, {'stored' if rows else 'random'} ids", flush=True)
                    found = fuzz(options.schemathesis, server.url, folder, token, rows, options.seconds / 2)
                    if found:
                        failures[f"{role}, {'stored' if rows else 'random'} ids"] = found
                log = server.log.read_text()
        answered |= answers(log)
        statuses = sorted({status for _, _, status in answers(log)})
        print(f"statuses that the server answered: {statuses}", flush=True)
        errors = [line for line in log.splitlines() if re.search(r'"status": 5|Traceback', line)]
        if errors:
            failures[f"{role}, log"] = "\n".join(errors[:20])
    for name, report in failures.items():
        print(f"\n##### {name}\n{report}")
    wanted = documented()
    unseen = Counter(status for _, _, status in wanted - answered)
    print(f"\nof {len(wanted)} documented statuses of operations, {len(wanted & answered)} were answered")
    print(f"not answered, by status: {dict(sorted(unseen.items()))}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
