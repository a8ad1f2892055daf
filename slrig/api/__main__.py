"""`python -m slrig.api` prints the description of the interface."""

import sys

from slrig.api.app import bare_app
from slrig.api.problems import text

if __name__ == "__main__":
    sys.stdout.write(text(bare_app()))
