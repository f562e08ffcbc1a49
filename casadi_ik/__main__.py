"""`python -m casadi_ik`: the command line."""

import sys

from casadi_ik.app.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
