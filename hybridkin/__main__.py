"""Run the command line: `python -m hybridkin`."""

import sys

from hybridkin.app.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
