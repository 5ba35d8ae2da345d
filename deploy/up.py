"""``freshfield-up`` from a checkout: ``python deploy/up.py SCENARIO`` (freshfield_up.cli)."""

import sys

from freshfield_up.cli import main

if __name__ == "__main__":
    sys.exit(main())
