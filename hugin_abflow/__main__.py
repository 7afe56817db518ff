"""``python -m hugin_abflow``: the same as the command ``hugin-abflow``."""

import sys

from hugin_abflow.cli import main

if __name__ == "__main__":
    sys.exit(main())
