"""`python -m tests.bench.fuzz SCHEMATHESIS [OPTIONS]`: that program (https://schemathesis.io, in an environment of its
own) against a service over the small rendered rig, with all its checks. OPTIONS are those of its `run`. Ends with its
exit status, or with 1 where the service logged a traceback.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from tests.e2e.conftest import KEY, ServiceProcess, write_rig

OPENAPI = Path(__file__).resolve().parents[2] / "config" / "openapi.json"
CONFIG = f"""
continue-on-failure = true
phases = {{ examples.enabled = true, coverage.enabled = true, fuzzing.enabled = true, stateful.enabled = true }}
suppress-health-check = ["all"]
request-timeout = 60
generation = {{ with-security-parameters = false, database = "none" }}
[auth.openapi]
header = {{ api_key = "{KEY}" }}
[checks]
# What a request asks for may be refused by the state of the rig, of the disk, or of what it names.
not_a_server_error = {{ expected-statuses = ["2xx", "3xx", "4xx", 501, 502, 503, 504, 507] }}
positive_data_acceptance = {{ expected-statuses = ["2xx", "3xx", "4xx", 501, 502, 503, 504, 507] }}
negative_data_rejection = {{ expected-statuses = ["4xx", 503] }}
[[operations]]
# It never ends, and where nothing happens it says nothing.
include-path = "/events"
enabled = false
"""


def main() -> int:
    """Make a scan, run the program, and look at the log."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "schemathesis.toml").write_text(CONFIG)
        service = ServiceProcess(write_rig(Path(folder) / "rig"), Path(folder) / "data")
        try:
            service.client().scan()
            command = [str(Path(sys.argv[1]).resolve()), "run", str(OPENAPI), "--url", service.url, *sys.argv[2:]]
            found = subprocess.run(command, cwd=folder, check=False).returncode  # noqa: S603 - as asked for
        finally:
            service.stop()
        log = service.log.read_text()
    sys.stdout.write(log)
    return found or int("Traceback" in log)


if __name__ == "__main__":
    sys.exit(main())
