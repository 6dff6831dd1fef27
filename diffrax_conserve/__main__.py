"""`python -m diffrax_conserve`."""

import sys

from .reproduce import run

if __name__ == "__main__":
    sys.exit(run())
