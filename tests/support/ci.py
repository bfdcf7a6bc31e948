"""Whether the tests run in continuous integration."""

import os

#: CI services set CI=true, and so does `.ci/run`
IN_CI = os.environ.get("CI", "").lower() in {"1", "true"}
