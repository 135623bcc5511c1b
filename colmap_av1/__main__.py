"""`python -m colmap_av1`."""

import sys

from colmap_av1.cli import main

if __name__ == "__main__":
    sys.exit(main())
