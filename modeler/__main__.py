"""Run the command line: as `python -m modeler`, and as the console script `modeler`."""

import gc
import os
import signal
import sys


def main() -> int:
    """Run one command and return its exit status."""
    gc.disable()  # until all is imported: a fiftieth of a build would go to looking for garbage where there is none
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during an import ends without a traceback
    from modeler.cli import main as run

    try:
        signal.signal(signal.SIGINT, before)
        return run()
    except KeyboardInterrupt:  # before the command could handle it
        return 128 + signal.SIGINT
    finally:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # all is done
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, signal.SIG_DFL)


if __name__ == "__main__":
    if not sys.flags.safe_path and sys.path[0] != os.path.dirname(os.path.dirname(__file__)):
        del sys.path[0]  # the current folder, whose Python files are no modules of ours
    sys.exit(main())
