"""Run the command line: as `python -m modeler`, and as the console script `modeler`."""

import signal
import sys


def main() -> int:
    """Run one command and return its exit status."""
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during an import ends without a traceback
    from modeler.cli import main as run

    try:
        signal.signal(signal.SIGINT, before)
        return run()
    except KeyboardInterrupt:  # before the command could handle it
        return 128 + signal.SIGINT


if __name__ == "__main__":
    sys.exit(main())
