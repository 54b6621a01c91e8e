"""Run the command line as `python -m modeler`."""

import sys

from modeler.cli import main

if __name__ == "__main__":
    sys.exit(main())
