"""The command ``hugin-abflow``, which is also ``python -m hugin_abflow``."""

import sys


def main() -> int:
    """Run the command with the process's own arguments and return its exit code."""
    try:
        from hugin_abflow.cli import main as run  # takes most of a second, in which Ctrl-C may come as well
    except KeyboardInterrupt:
        print("hugin-abflow: interrupted", file=sys.stderr)
        return 130  # ExitCode.INTERRUPTED
    return run()


if __name__ == "__main__":
    sys.exit(main())
